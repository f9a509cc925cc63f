"""The viewer's server: what it sends, to whom, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urljoin
from urllib.request import urlopen

import numpy as np
import pytest

from tests.kit.http_ranges import serve
from tests.kit.stores import StoreSpec, root_attributes, write_episode, write_store
from tests.kit.viewer import ask, ask_target, send, served
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.analyze.view.summaries import Summary
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("served") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def server(store):
    with served(store) as running:
        yield running


def test_it_listens_on_the_loopback_only(server):
    assert server.server_address[0] == "127.0.0.1"
    assert len(server.token) >= 32
    assert server.link == f"http://127.0.0.1:{server.server_address[1]}/{server.token}/"


def test_the_page_and_its_files_are_sent_with_their_rules(server):
    for path, kind in (("", "text/html"), ("main.js", "text/javascript"), ("main.css", "text/css")):
        reply = ask(server, path)
        assert reply.status == 200
        assert reply.headers["content-type"].startswith(kind)
        assert int(reply.headers["content-length"]) == len(reply.body) > 0
        rules = dict(rule.split(" ", 1) for rule in reply.headers["content-security-policy"].split("; "))
        assert rules["default-src"] == "'none'"
        assert rules["connect-src"] == "'self'"
        assert "unsafe-inline" not in str(rules)
        assert "unsafe-eval" not in str(rules)
        assert not [rule for rule in rules.values() if "http" in rule or "*" in rule]
        assert reply.headers["x-content-type-options"] == "nosniff"
        assert reply.headers["referrer-policy"] == "no-referrer"
        assert "server" not in reply.headers


@pytest.mark.parametrize("method", ["POST", "OPTIONS", "get", "X" * 3000])
def test_other_methods_are_refused(server, method):
    reply = ask(server, "runs.json", method)
    assert reply.status == 405
    assert b"runs" not in reply.body


@pytest.mark.parametrize("target", ["/", "/runs.json", "/wrong/runs.json", "/../", "http://127.0.0.1/", "*"])
def test_nothing_is_said_without_the_token(server, target):
    reply = ask_target(server, target)
    assert reply.status == 403
    assert server.token.encode() not in reply.body
    assert b"a.zarr" not in reply.body


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "", None, "a b", "<b>", "x" * 300])
def test_another_host_is_refused_even_with_the_token(server, host):
    reply = ask(server, "runs.json", host=host)
    assert reply.status == 403
    named = host is not None and "example" in host
    assert (f"--allow-host {host.partition(':')[0]}" if named else "Forbidden.") in reply.body.decode()
    assert named or reply.body == b"Forbidden.\n"


@pytest.mark.parametrize("host", ["hub.example.org", "HUB.example.org:443", "10.0.0.7:80", "localhost:8765"])
def test_allowed_hosts_are_let_in_and_no_other(store, host):
    with served(store, allow_hosts=("hub.example.org", "10.0.0.7:80")) as server:
        assert ask(server, "runs.json", host=host).status == 200
        for other in ("example.org", "a.hub.example.org", "hub.example.org.evil.example", "hub.example.org@evil"):
            assert ask(server, "runs.json", host=other).status == 403
        assert ask_target(server, "/runs.json", host=host).status == 403


@pytest.mark.parametrize(
    "name", ["https://hub.example.org", "hub.example.org/user", "*", "", "a b", "hub.example.org:x"]
)
def test_what_is_no_name_of_a_host_is_refused(name):
    with pytest.raises(BadArgument, match="--allow-host"):
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


@pytest.mark.parametrize(
    ("prefix", "strips"),
    [("/user/me/proxy/8765/", True), ("/user/me/proxy/absolute/8765/", False), ("/node/c01/8765/", False)],
)
def test_the_page_and_its_answers_are_there_behind_a_proxy(store, prefix, strips):
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
        (entry,) = json.loads(read("runs.json"))["runs"]
        about = json.loads(read(f"runs/0/{entry['episodes'][0]['name']}/about.json"))
        assert about["num_replans"] == 2


def test_two_hosts_are_refused(server):
    request = f"GET /{server.token}/runs.json HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n"
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


def test_no_file_of_a_store_is_sent(server, store):
    """What a link in a store leads to is in no answer either: answers are made of sealed arrays."""
    for path in (path for path in store.rglob("*") if path.is_file()):
        for root in ("stores/0", "runs/0"):
            assert ask(server, f"{root}/{path.relative_to(store).as_posix()}").status == 404


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
    assert ask(server, "runs.json").status == 200


def test_episodes_that_are_captured_meanwhile_are_listed(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    with served(path) as running:
        write_episode(open_run(path, root_attributes(SPEC), "resume"), SPEC, 0, 5)
        (found,) = json.loads(ask(running, "runs.json").body)["runs"]
        assert found["episodes"][-1]["name"] == "task000_episode005"


def told(running: ViewerServer) -> tuple[list[bool | None], list[float | None]]:
    """Outcomes and ratios of the episodes that the page lists, when all is computed."""
    (found,) = json.loads(ask(running, "runs.json").body)["runs"]
    running.stores[0].summary.wait()
    numbers = json.loads(ask(running, "runs/0/numbers.json").body)
    assert numbers["complete"]
    assert numbers["failed"] is None
    return [one["outcome"] for one in found["episodes"]], [one["ratio"] for one in numbers["episodes"]]


def test_a_store_that_was_replaced_under_its_name_is_shown_as_it_is_now(tmp_path):
    """The same run again, with the same episodes: another outcome, other rows, other effects."""

    def other_rows(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
        rows = rows.copy()
        rows[..., :4] *= 3.0
        return rows / rows.sum(axis=-1, keepdims=True)

    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_success=lambda *_: True))
    with served(path) as running:
        running.stores[0].summary.begin(running.stores[0].store)
        outcomes, ratios = told(running)
        about = ask(running, "runs/0/task000_episode000/about.json").body
        assert outcomes == [True, True]
        shutil.rmtree(path)
        write_store(path, spec=replace(SPEC, plant_success=lambda *_: False, plant_rows=other_rows))
        now, new_ratios = told(running)
        assert now == [False, False]
        assert None not in new_ratios
        assert not set(new_ratios) & set(ratios)
        assert ask(running, "runs/0/task000_episode000/about.json").body != about


def test_what_python_prints_by_itself_does_not_end_the_summary(store, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("print('[1]'); print('{}'); print('loaded', end='')\n")
    monkeypatch.syspath_prepend(tmp_path)
    summary = Summary()
    summary.begin(open_store(store))
    assert summary.wait() is None
    assert None not in [one["ratio"] for one in summary.document()["episodes"]]


def test_a_store_that_goes_away_is_a_sentence(tmp_path, store):
    place = tmp_path / "a.zarr"
    copy_store(open_store(store), place, ())
    with served(place) as running:
        assert ask(running, "runs/0/task000_episode000/about.json").status == 200
        place.rename(tmp_path / "b.zarr")
        gone = ask(running, "runs/0/task000_episode001/about.json")
        assert gone.status == 410
        assert str(place) in json.loads(gone.body)["error"]
        assert len(json.loads(ask(running, "runs.json").body)["runs"]) == 1


def test_a_store_elsewhere_is_served(tmp_path, store):
    pytest.importorskip("aiohttp")
    copy = tmp_path / "copied" / "p.zarr"
    copy_store(open_store(store), copy, ())
    path = "task000_episode000/joint/rows/mean.npy"
    with serve(copy.parent) as elsewhere, served(copy, f"{elsewhere.url}/p.zarr") as running:
        here, there = (ask(running, f"runs/{number}/{path}") for number in (0, 1))
        assert (here.status, here.body) == (200, there.body)
        elsewhere.status = 500
        broken = ask(running, "runs/1/task000_episode001/about.json")
        assert broken.status == 502
        assert json.loads(broken.body)["error"]


def test_a_port_in_use_is_refused(server):
    with pytest.raises(BadArgument, match=str(server.server_address[1])):
        ViewerServer((), server.server_address[1])
