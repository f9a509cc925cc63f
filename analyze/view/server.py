"""The viewer's web server: on the loopback only, for who has the link, and with the page and its answers only.

The link's secret part keeps out other users and programs of this machine, the check of the host keeps out sites that
a browser has open (the host of a proxy is allowed by its name), and the content security policy keeps the page from
asking for anything elsewhere, whatever a store holds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from vla_attention.analyze.view.answers import Answers, StoreGone, error_answer
from vla_attention.analyze.view.kept_token import kept_token, new_token
from vla_attention.analyze.view.paths import (
    BUNDLE,
    LOOPBACK_NAMES,
    PAGE_FILES,
    RUNS,
    NothingThere,
    WrongToken,
    name_of_host,
    wanted,
)
from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stores.remote_source import RemoteFailure

LOOPBACK = "127.0.0.1"
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    # A store may be captured anew under its name, and the link be used by the next server on this port.
    "Cache-Control": "no-store",
}
_OTHER_HOST = (
    "The page of vla-attention view is asked for as {0}, a host that it does not know. If that is the proxy through "
    "which you reach this machine (JupyterHub, Open OnDemand), start it again with --allow-host {0}."
)
#: Seconds after which a connection on which nothing is said is closed.
_SILENT_S = 60


@dataclass(frozen=True)
class Answer:
    """What is sent: a status, the content and its type, and further headers."""

    status: int
    content: bytes
    kind: str = "text/plain; charset=utf-8"
    headers: Mapping[str, str] = field(default_factory=dict)


class ViewerServer(ThreadingHTTPServer):
    """The server of some stores. `link` opens the page.

    Args:
        stores: what the page shows.
        port: of the link; 0 is any free one.
        allow_hosts: names under which a proxy asks for the page, beside the loopback's.
        keep_link: whether to take the link that these stores had on this port before. `keeps_link` says whether they
            will have this one again.

    Raises:
        BadArgument: the port cannot be had, or an allowed host is no name of one.
    """

    daemon_threads = True

    def __init__(
        self, stores: Sequence[ServedStore], port: int = 0, *, allow_hosts: Sequence[str] = (), keep_link: bool = False
    ) -> None:
        if not 0 <= port < 2**16:
            raise BadArgument(f"Cannot use --port {port}; expected a number from 1 to 65535, or 0 for any free port.")
        self.allowed = LOOPBACK_NAMES.union(map(_allowed_host, allow_hosts))
        self.stores = tuple(stores)
        self.page = {name: (BUNDLE / name).read_bytes() for name in PAGE_FILES}
        self._answers = Answers()
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except OSError as error:
            reason = error.strerror or error
            raise BadArgument(f"Cannot use --port {port}: {reason}. Leave it out for any free port.") from None
        # Only who has the port writes its token.
        kept = kept_token([one.store.path for one in self.stores], self.port) if keep_link else None
        self.keeps_link = kept is not None
        self.token = kept or new_token()

    @property
    def port(self) -> int:
        """The port that it has."""
        return int(self.server_address[1])

    @property
    def link(self) -> str:
        """The address of the page."""
        return f"http://{LOOPBACK}:{self.port}/{self.token}/"

    def handle_error(self, *_: object) -> None:
        """A browser that closes a connection is no error; every other one was answered."""

    def answer(self, target: str) -> Answer:
        """The answer to a request that was let in: `target` as it stands in the request."""
        try:
            names, query = wanted(target, self.token)
            if names[0] in self.page:
                return Answer(200, self.page[names[0]], PAGE_FILES[names[0]])
            if names == [RUNS]:
                for store in self.stores:
                    store.refresh()
            with ExitStack() as stack:  # what a person waits for goes before the list's numbers
                for store in self.stores:
                    stack.enter_context(store.summary.paused())
                return Answer(200, *self._answers.answer(self.stores, names, query))
        except WrongToken:
            return Answer(403, b"This is the page of vla-attention view: open the whole link that it printed.\n")
        except NothingThere:
            return Answer(HTTPStatus.NOT_FOUND, b"There is nothing here.\n")
        except RemoteFailure as error:
            return Answer(HTTPStatus.BAD_GATEWAY, *error_answer(error))
        except StoreGone as error:
            return Answer(HTTPStatus.GONE, *error_answer(error))
        except UserError as error:
            # A browser logs every other status as an error; a wrong selector is the user's, and the page says it.
            return Answer(HTTPStatus.OK if query else HTTPStatus.UNPROCESSABLE_ENTITY, *error_answer(error))
        except OSError as error:  # the store changes
            return Answer(HTTPStatus.UNPROCESSABLE_ENTITY, *error_answer(error.strerror or error))


def _allowed_host(given: str) -> str:
    name = name_of_host(given)
    if name is None:
        raise BadArgument(
            f"Cannot use --allow-host '{given}': expected the name of a host, as hub.example.org, without https:// and "
            "without a path."
        )
    return name


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: ViewerServer
    protocol_version = "HTTP/1.1"
    timeout = _SILENT_S
    # The bytes follow the headers at once; else each answer waits 40 ms until the browser has acknowledged the headers.
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer, with the bytes unless it is HEAD that asks."""
        hosts = self.headers.get_all("Host", [])
        name = name_of_host(hosts[0].strip()) if len(hosts) == 1 else None
        if name not in self.server.allowed:
            self.send_error(403, name and _OTHER_HOST.format(name))
            return
        if "Content-Length" in self.headers or "Transfer-Encoding" in self.headers:
            self.send_error(400)
            return
        self._send(self.server.answer(self.path))

    do_HEAD = do_GET

    def _send(self, answer: Answer) -> None:
        self.send_response_only(answer.status)
        own = {"Content-Type": answer.kind, "Content-Length": str(len(answer.content))}
        for name, value in {**own, **_HEADERS, **answer.headers}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse a request, by `message` where it is a sentence of ours, and close the connection."""
        self.close_connection = True
        self.command = getattr(self, "command", None) or "GET"
        self.request_version = self.protocol_version  # of a request that is none, it is not known
        headers = {"Allow": "GET, HEAD"} if code in (405, 501) else {}
        status = 405 if code == 501 else code
        sentence = message if status == HTTPStatus.FORBIDDEN and message else f"{HTTPStatus(status).phrase}."
        self._send(Answer(status, f"{sentence}\n".encode(), headers=headers))

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is printed: the terminal shows the link."""
