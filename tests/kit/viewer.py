"""The viewer's server in a thread, and requests whose bytes a test chooses."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.analyze.view.summaries import Summary
from vla_attention.schemas.stores.reader import open_store


@contextmanager
def served(*places: str | Path, summaries: bool = False, allow_hosts: Sequence[str] = ()) -> Iterator[ViewerServer]:
    """Serve stores until the end of the block; summaries: compute them, too. allow_hosts: as `--allow-host`."""
    with ExitStack() as stack:
        stores = [ServedStore(open_store(place), stack.enter_context(closing(Summary()))) for place in places]
        for store in stores if summaries else ():
            store.summary.begin(store.store)
        server = stack.enter_context(ViewerServer(stores, allow_hosts=allow_hosts))
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(server.shutdown)
        yield server


@dataclass(frozen=True)
class Reply:
    """What a server sent: its status, its headers by their names in lower case, and the rest."""

    status: int
    headers: dict[str, str]
    body: bytes


def ask(server: ViewerServer, path: str, method: str = "GET", host: str | None = "127.0.0.1", **headers: str) -> Reply:
    """Ask for a path below the link, which is sent as it is; underscores in the names of headers are hyphens."""
    return ask_target(server, f"/{server.token}/{path}", method, host, **headers)


def ask_target(
    server: ViewerServer, target: str, method: str = "GET", host: str | None = "127.0.0.1", **headers: str
) -> Reply:
    """Ask for a target, which is sent as it is."""
    lines = [f"{method} {target} HTTP/1.1", *([] if host is None else [f"Host: {host}"])]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return send(server, ("\r\n".join([*lines, "Connection: close", "", ""])).encode("latin-1"))


def send(server: ViewerServer, request: bytes) -> Reply:
    """Send bytes, and read until the server closes the connection."""
    with socket.create_connection(server.server_address[:2], timeout=20) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        content = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = content.partition(b"\r\n\r\n")
    first, *lines = head.decode("latin-1").split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    return Reply(int(first.split()[1]) if first else 0, headers, body)
