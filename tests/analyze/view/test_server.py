"""The viewer's server: what it sends, to whom, and what it refuses."""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urljoin
from urllib.request import urlopen

import pytest

from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.http_ranges import serve
from tests.kit.stores import StoreSpec, root_attributes, write_episode, write_store
from tests.kit.viewer import ask, ask_target, send, served
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("served") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def server(store):
    with served(store) as running:
        yield running


def rows_file(store: Path) -> Path:
    (found,) = (store / "episodes/task000_episode000/joint/rows").glob("c*")
    return found


def test_it_listens_on_the_loopback_only(server):
    assert server.server_address[0] == "127.0.0.1"
    assert len(server.token) >= 32
    assert server.link == f"http://127.0.0.1:{server.server_address[1]}/{server.token}/"


def test_the_page_and_its_files_are_sent_with_their_rules(server):
    for path, kind in (("", "text/html"), ("viewer.js", "text/javascript"), ("viewer.css", "text/css")):
        reply = ask(server, path)
        assert reply.status == 200
        assert reply.headers["content-type"].startswith(kind)
        assert int(reply.headers["content-length"]) == len(reply.body) > 0
        rules = dict(rule.split(" ", 1) for rule in reply.headers["content-security-policy"].split("; "))
        assert rules["default-src"] == "'none'"
        assert rules["connect-src"] == "'self'"
        assert "unsafe-inline" not in str(rules)
        assert "'unsafe-eval'" not in str(rules)
        assert not [rule for rule in rules.values() if "http" in rule or "*" in rule]
        assert reply.headers["x-content-type-options"] == "nosniff"
        assert reply.headers["referrer-policy"] == "no-referrer"
        assert "server" not in reply.headers


def test_every_file_of_the_store_is_sent_as_it_is(server, store):
    files = [path for path in sorted(store.rglob("*")) if path.is_file()]
    assert len(files) > 20
    for path in files:
        reply = ask(server, f"stores/0/{path.relative_to(store).as_posix()}")
        assert (reply.status, reply.body) == (200, path.read_bytes()), path
        assert reply.headers["content-type"] == "application/octet-stream"


def test_parts_of_files_are_sent(server, store):
    file = rows_file(store)
    name, content = f"stores/0/{file.relative_to(store).as_posix()}", file.read_bytes()
    for header, expected in (
        ("bytes=3-9", content[3:10]),
        ("bytes=-20", content[-20:]),
        (f"bytes={len(content) - 1}-", content[-1:]),
        (f"bytes=5-{10 * len(content)}", content[5:]),
    ):
        reply = ask(server, name, Range=header)
        assert (reply.status, reply.body) == (206, expected)
        assert reply.headers["content-range"].endswith(f"/{len(content)}")
        assert int(reply.headers["content-length"]) == len(expected)
    beyond = ask(server, name, Range=f"bytes={len(content)}-")
    assert (beyond.status, beyond.headers["content-range"]) == (416, f"bytes */{len(content)}")
    several = ask(server, name, Range="bytes=0-1,4-5")
    assert (several.status, several.body) == (200, content)


@pytest.mark.parametrize("method", ["POST", "OPTIONS", "get", "X" * 3000])
def test_other_methods_are_refused(server, method):
    reply = ask(server, "stores.json", method)
    assert reply.status == 405
    assert b"stores" not in reply.body


@pytest.mark.parametrize("target", ["/", "/stores.json", "/wrong/stores.json", "/../", "http://127.0.0.1/", "*"])
def test_nothing_is_said_without_the_token(server, target):
    reply = ask_target(server, target)
    assert reply.status == 403
    assert server.token.encode() not in reply.body
    assert b"a.zarr" not in reply.body


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "", None, "a b", "<b>", "x" * 300])
def test_another_host_is_refused_even_with_the_token(server, host):
    reply = ask(server, "stores.json", host=host)
    assert reply.status == 403
    named = host is not None and "example" in host
    assert (f"--allow-host {host.partition(':')[0]}" if named else "Forbidden.") in reply.body.decode()
    assert named or reply.body == b"Forbidden.\n"


@pytest.mark.parametrize("host", ["hub.example.org", "HUB.example.org:443", "10.0.0.7:80", "localhost:8765"])
def test_allowed_hosts_are_let_in_and_no_other(store, host):
    with served(store, allow_hosts=("hub.example.org", "10.0.0.7:80")) as server:
        assert ask(server, "stores.json", host=host).status == 200
        for other in ("example.org", "a.hub.example.org", "hub.example.org.evil.example", "hub.example.org@evil"):
            assert ask(server, "stores.json", host=other).status == 403
        assert ask_target(server, "/stores.json", host=host).status == 403


@pytest.mark.parametrize(
    "name", ["https://hub.example.org", "hub.example.org/user", "*", "", "a b", "hub.example.org:x"]
)
def test_what_is_no_name_of_a_host_is_refused(name):
    with pytest.raises(BadArgument, match=r"--allow-host .*expected the name of a host"):
        ViewerServer((), allow_hosts=(name,))


@contextmanager
def proxied(server: ViewerServer, prefix: str, strips: bool) -> Iterator[str]:
    """The address of a proxy that hands on what is below `prefix`, with its own Host, as JupyterHub and others do."""

    class Proxy(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            assert self.path.startswith(prefix)
            target = f"/{self.path.removeprefix(prefix)}" if strips else self.path
            kept = {"Range": self.headers["Range"]} if "Range" in self.headers else {}
            connection = HTTPConnection("127.0.0.1", server.port)
            connection.request("GET", target, headers={"Host": "hub.example.org", "X-Forwarded-Proto": "https", **kept})
            reply = connection.getresponse()
            body = reply.read()
            self.send_response(reply.status)
            for name, value in reply.getheaders():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Proxy) as proxy:
        threading.Thread(target=proxy.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield f"http://127.0.0.1:{proxy.server_address[1]}{prefix}"
        proxy.shutdown()


@needs_node
@pytest.mark.parametrize(
    ("prefix", "strips"),
    [("/user/me/proxy/8765/", True), ("/user/me/proxy/absolute/8765/", False), ("/node/c01/8765/", False)],
)
def test_the_page_reads_its_store_behind_a_proxy(store, tmp_path, prefix, strips):
    with (
        served(store, allow_hosts=("hub.example.org",)) as server,
        proxied(server, prefix, strips) as address,
    ):
        base = f"{address}{server.token}/"

        def read(name: str) -> bytes:
            with urlopen(urljoin(base, name)) as reply:  # noqa: S310 - the test's own proxy
                return reply.read()

        for name in re.findall(r'(?:href|src)="([^"]+)"', read("").decode()):
            assert name == "data:," or read(name)
        (entry,) = json.loads(read("stores.json"))["stores"]
        (answer,) = page_answers(tmp_path, [PageQuestion(base, entry["root"])])
        assert answer.get("failure") is None
        assert len(answer["replans"]) == 2


def test_two_hosts_are_refused(server):
    request = f"GET /{server.token}/stores.json HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n"
    assert send(server, request.encode()).status == 403


@pytest.mark.parametrize(
    "path",
    [
        "stores/0/../../../etc/passwd",
        "stores/0/episodes/..%2f..%2f..%2fsecret",
        "stores/0/episodes/..\\..\\secret",
        "stores/0/episodes/",
        "stores/0/secret",
        "stores/7/zarr.json",
    ],
)
def test_nothing_outside_of_the_store_is_sent(server, store, path):
    (store.parent / "secret").write_text("secret")
    (store / "secret").write_text("secret")
    reply = ask(server, path)
    assert (reply.status, reply.body) == (404, b"There is nothing here.\n")


def test_links_out_of_the_store_and_what_is_no_file_are_not_sent(tmp_path):
    store = write_store(tmp_path / "a.zarr", spec=SPEC)
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets/file").write_text("secret")
    episodes = store / "episodes"
    (episodes / "absolute").symlink_to(tmp_path / "secret")
    (episodes / "relative").symlink_to("../../secret")
    (episodes / "folder").symlink_to(tmp_path / "secrets")
    (episodes / "twice").symlink_to("relative")
    (episodes / "circle").symlink_to("circle")
    (episodes / "inside").symlink_to("../zarr.json")
    os.mkfifo(episodes / "fifo")
    with served(store) as running:
        for name in ("absolute", "relative", "folder/file", "twice", "circle", "fifo", "folder"):
            assert ask(running, f"stores/0/episodes/{name}").status == 404, name
            assert ask(running, f"stores/0/episodes/{name}", Range="bytes=0-3").status == 404, name
        assert ask(running, "stores/0/episodes/inside").body == (store / "zarr.json").read_bytes()
        # A folder that becomes a link while the server runs, after its files were read.
        folder = episodes / "task000_episode001"
        assert ask(running, "stores/0/episodes/task000_episode001/zarr.json").status == 200
        folder.rename(tmp_path / "moved")
        folder.symlink_to(tmp_path / "moved")
        assert ask(running, "stores/0/episodes/task000_episode001/zarr.json").status == 404


@pytest.mark.parametrize(
    ("request_", "statuses"),
    [
        (b"GET /TOKEN/ HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * 70_000 + b"\r\n\r\n", {431}),
        (b"GET /TOKEN/" + b"a" * 70_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", {414}),
        (b"GET /TOKEN/ HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n\r\nhello", {400}),
        (b"GET /TOKEN/ HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", {400}),
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)), {0, 400}),
        (b"", {0}),
    ],
)
def test_malformed_requests_are_refused_and_the_server_goes_on(server, request_, statuses):
    assert send(server, request_.replace(b"TOKEN", server.token.encode())).status in statuses
    assert ask(server, "stores.json").status == 200


def test_the_document_lists_stores_and_episodes(server, store):
    document = json.loads(ask(server, "stores.json").body)
    names = [f"task000_episode00{i}" for i in range(2)]
    assert document == {
        "stores": [
            {
                "name": "a.zarr",
                "root": "stores/0/",
                "episodes": [{"name": name} for name in names],
                "summary": "stores/0.summary.json",
                "path": str(store),
            }
        ]
    }
    assert ask(server, "stores/0.summary.json").headers["content-type"] == "application/json"


def test_episodes_that_are_captured_meanwhile_are_listed(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    with served(path) as running:
        write_episode(open_run(path, root_attributes(SPEC), "resume"), SPEC, 0, 5)
        (found,) = json.loads(ask(running, "stores.json").body)["stores"]
        assert found["episodes"][-1] == {"name": "task000_episode005"}


def test_a_store_elsewhere_is_served(tmp_path, store):
    pytest.importorskip("aiohttp")
    copy = tmp_path / "copied" / "p.zarr"
    copy_store(open_store(store), copy, ())
    (path,) = copy.glob("episodes/task000_episode000/joint/rows/c*")
    name, content = path.relative_to(copy).as_posix(), path.read_bytes()
    with serve(copy.parent) as elsewhere, served(copy, f"{elsewhere.url}/p.zarr") as running:
        for number in (0, 1):
            reply = ask(running, f"stores/{number}/{name}", Range=f"bytes={len(content) - 30}-")
            assert (reply.status, reply.body) == (206, content[-30:])
            assert ask(running, f"stores/{number}/{name}", Range="bytes=4-9").body == content[4:10]
            assert ask(running, f"stores/{number}/episodes/nothing").status == 404
        elsewhere.forget()
        ask(running, f"stores/1/{name}", Range="bytes=100-199")
        assert elsewhere.of_episodes() == 100
        elsewhere.status = 500
        broken = ask(running, f"stores/1/{name}", Range="bytes=0-9")
        assert broken.status == 502
        assert b"cannot be read" in broken.body


def test_a_port_in_use_is_refused(server):
    with pytest.raises(BadArgument, match="Leave it out"):
        ViewerServer((), server.server_address[1])
