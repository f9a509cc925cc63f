"""A web server on the loopback that serves a folder, with ranges, and counts what it sends."""

from __future__ import annotations

import mimetypes
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote


@dataclass
class Served:
    """What was asked for, and how the server answers.

    Attributes:
        url: the address of the folder.
        sent: bytes sent of each file, by its path below the folder.
        requests: the path and the range of each request, in order.
        ranges: whether parts of files are sent; without, every answer is a whole file.
        change: gets the path and the bytes of an answer, and gives those that are sent.
        announce: whether an answer states how long it is without `change`, so that one cut short breaks off.
        status: answers every request with this one.
        redirect: a server to which every request is sent on.
        authorizations: what requests gave to say who asks; "" for nothing.
    """

    url: str
    sent: dict[str, int] = field(default_factory=dict)
    requests: list[tuple[str, str]] = field(default_factory=list)
    ranges: bool = True
    change: Callable[[str, bytes], bytes] | None = None
    announce: bool = False
    status: int = 200
    redirect: str = ""
    authorizations: set[str] = field(default_factory=set)

    def forget(self) -> None:
        """Begin to count anew."""
        self.sent.clear()
        self.requests.clear()

    def of_episodes(self) -> int:
        """Bytes sent of episodes' files."""
        return sum(count for path, count in self.sent.items() if "/episodes/" in path)


@contextmanager
def serve(folder: Path) -> Iterator[Served]:
    """Serve a folder until the end of the block."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path = unquote(self.path.partition("?")[0]).lstrip("/")
            wanted = self.headers.get("Range") or ""
            served.requests.append((path, wanted))
            served.authorizations.add(self.headers.get("Authorization") or "")
            if served.redirect:
                self.answer(302, b"", path, {"Location": f"{served.redirect}/{path}"})
                return
            file = folder / path
            if served.status != 200 or not file.is_file():
                self.answer(served.status if served.status != 200 else 404, b"")
                return
            whole = file.read_bytes()
            match = re.fullmatch(r"bytes=(?:(\d+)-(\d*)|-(\d+))", wanted) if served.ranges else None
            if match is None:
                self.answer(200, whole, path)
                return
            first = max(0, len(whole) - int(match[3])) if match[3] else int(match[1])
            last = min(int(match[2] or len(whole) - 1), len(whole) - 1)
            if first >= len(whole):
                self.answer(416, b"", path, {"Content-Range": f"bytes */{len(whole)}"})
                return
            self.answer(206, whole[first : last + 1], path, {"Content-Range": f"bytes {first}-{last}/{len(whole)}"})

        do_HEAD = do_GET

        def answer(self, status: int, content: bytes, path: str = "", more: dict[str, str] | None = None) -> None:
            changed = served.change(path, content) if served.change is not None and content else content
            self.send_response(status)
            for name, value in (more or {}).items():
                self.send_header(name, value)
            # Browsers run no script that is not called one.
            self.send_header("Content-Type", mimetypes.guess_type(path)[0] or "application/octet-stream")
            self.send_header("Content-Length", str(len(content if served.announce else changed)))
            self.end_headers()
            if self.command == "GET":
                # Counted first: a test may look as soon as it has the answer.
                served.sent[path] = served.sent.get(path, 0) + len(changed)
                self.wfile.write(changed)
            if served.announce and len(changed) != len(content):
                self.close_connection = True

        def log_message(self, *_: Any) -> None:
            """Nothing is printed."""

    class Server(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *_: Any) -> None:
            """A client that goes away is no error."""

    server = Server(("127.0.0.1", 0), Handler)
    served = Served(f"http://127.0.0.1:{server.server_address[1]}")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
