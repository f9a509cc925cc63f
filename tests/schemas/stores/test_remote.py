"""Stores at an address: what a server sends wrongly is never a number."""

from __future__ import annotations

import gzip
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra remote: pip install '.[remote]'")


from tests.kit.http_ranges import Served, serve
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import copy_store
from vla_attention.schemas.errors import Note, UserError
from vla_attention.schemas.stores import remote_source
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.remote_source import RemoteFolder
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.store_url import StoreUrl, store_place
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2)


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("copied")
    copy_store(open_store(write_store(made / "folder.zarr", spec=SPEC)), made / "a.zarr", ())
    return made / "a.zarr"


@pytest.fixture
def server(copied, tmp_path) -> Iterator[Served]:
    shutil.copytree(copied, tmp_path / "served" / "a.zarr")
    with serve(tmp_path / "served") as served:
        yield served


def read_all(url: str, expected: Path) -> list[str]:
    """The sentences with which reading is refused; all that is read must equal what is in the store here."""
    said: list[str] = []
    recorded = {one.name: one for one in open_store(expected).episodes}
    try:
        store = open_store(url)
    except UserError as error:
        return [str(error)]
    for episode in store.episodes:
        try:
            names = episode.attributes.arrays
        except UserError as error:
            said.append(str(error))
            continue
        for name in names:
            try:
                values = episode.read(name)
            except UserError as error:
                said.append(str(error))
            else:
                assert np.array_equal(values, recorded[episode.name].read(name), equal_nan=True), name
    assert not any("\n" in sentence for sentence in said)
    return said


def results(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.suffix in (".csv", ".json", ".txt")
    }


def test_a_web_server_needs_the_list_that_a_copy_has(server, tmp_path):
    (tmp_path / "served/a.zarr/episodes.json").write_text('["../x"]')
    with pytest.raises(StoreError, match=r"episodes\.json"):
        open_store(f"{server.url}/a.zarr")
    (tmp_path / "served/a.zarr/episodes.json").unlink()
    with pytest.raises(StoreError, match="store copy"):
        open_store(f"{server.url}/a.zarr")


def test_a_store_is_read_by_its_address(server, copied):
    store = open_store(f"{server.url}/a.zarr")
    assert store.path == StoreUrl(f"{server.url}/a.zarr")
    assert [episode.name for episode in store.episodes] == [episode.name for episode in open_store(copied).episodes]
    assert read_all(f"{server.url}/a.zarr", copied) == []
    assert verify_store(store) == []


def test_one_request_opens_an_episode(server):
    episode = open_store(f"{server.url}/a.zarr").episodes[0]
    server.forget()
    for name in episode.attributes.arrays:
        assert episode.shape_of(name)
    assert [path for path, _ in server.requests] == [f"a.zarr/episodes/{episode.name}/seal/zarr.json"]


@pytest.mark.thorough
def test_damaged_answers_are_never_a_number(server, copied):
    url = f"{server.url}/a.zarr"
    generator = np.random.default_rng(0)

    def flip(path: str, content: bytes) -> bytes:
        if "/episodes/" not in path:
            return content
        at = int(generator.integers(len(content)))
        return content[:at] + bytes([content[at] ^ 0x20]) + content[at + 1 :]

    server.change = flip
    for _ in range(3):
        assert read_all(url, copied)
    server.change = None
    assert read_all(url, copied) == []


@pytest.mark.thorough
@pytest.mark.parametrize("announce", [False, True])
def test_short_answers_are_never_a_number(server, copied, announce):
    url = f"{server.url}/a.zarr"
    for keep in (0, 1, 0.5):
        server.announce = announce
        server.change = lambda path, content, keep=keep: content[: int(len(content) * keep) if keep < 1 else -1]
        assert read_all(url, copied)
        server.change = lambda path, content, keep=keep: (
            content[: int(len(content) * keep) if keep < 1 else -1] if "/episodes/" in path else content
        )
        assert read_all(url, copied)


@pytest.mark.thorough
def test_an_answer_of_another_place_is_never_a_number(server, copied):
    """A proxy that answers every part with the beginning of the file."""
    whole = {f"a.zarr/{file.relative_to(copied)}": file.read_bytes() for file in copied.rglob("c.*")}
    server.change = lambda path, content: whole[path][: len(content)] if path in whole else content
    assert read_all(f"{server.url}/a.zarr", copied)


def test_a_server_that_does_not_answer_is_a_sentence(server, monkeypatch):
    monkeypatch.setattr(remote_source, "ANSWER_WITHIN_S", 0.2)
    ends = threading.Event()
    server.change = lambda path, content: content if ends.wait(60) else b""
    try:
        with pytest.raises(UserError, match=" 0 s"):
            open_store(f"{server.url}/a.zarr")
    finally:
        ends.set()


@contextmanager
def answering(answer: Callable[[BaseHTTPRequestHandler], None]) -> Iterator[str]:
    """The address of a server that answers everything in one way."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            with suppress(OSError):
                answer(self)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/a.zarr"
        finally:
            server.shutdown()


def endless(handler: BaseHTTPRequestHandler) -> None:
    handler.end_headers()
    while True:
        handler.wfile.write(b" " * 1_000_000)


def compressed(handler: BaseHTTPRequestHandler) -> None:
    content = gzip.compress(bytes(300_000_000), 1)
    handler.send_header("Content-Encoding", "gzip")
    handler.send_header("Content-Length", str(len(content)))
    handler.end_headers()
    handler.wfile.write(content)


def dripping(handler: BaseHTTPRequestHandler) -> None:
    handler.end_headers()
    while True:
        handler.wfile.write(b" ")
        time.sleep(0.05)


@pytest.mark.parametrize("answer", [endless, compressed, dripping], ids=lambda answer: answer.__name__)
def test_an_answer_without_end_ends_with_a_sentence(monkeypatch, answer):
    monkeypatch.setattr(remote_source, "ANSWER_WITHIN_S", 0.3 if answer is dripping else 60)
    with answering(answer) as url:
        with pytest.raises(UserError) as caught:
            open_store(url)
        with pytest.raises(OSError, match=url):
            RemoteFolder(url).part("a", 0, 10)
    assert "\n" not in str(caught.value)


def test_a_list_that_lacks_episodes_is_named_where_the_server_shows_them(copied, tmp_path):
    store = Path(shutil.copytree(copied, tmp_path / "a.zarr"))
    (store / "episodes.json").write_text('["task000_episode001"]')

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with pytest.warns(Note, match="task000_episode000"):
                opened = open_store(f"http://127.0.0.1:{server.server_address[1]}/a.zarr")
            shutil.copy(copied / "episodes.json", store / "episodes.json")
            assert open_store(str(opened.path)).notes == ()
        finally:
            server.shutdown()
    assert [episode.name for episode in opened.episodes] == ["task000_episode001"]
    assert len(opened.notes) == 1


def test_a_server_without_ranges_is_refused_with_a_sentence(server, copied, capsys):
    server.ranges = False
    assert "range" in " ".join(read_all(f"{server.url}/a.zarr", copied))
    assert analyze(["words", f"{server.url}/a.zarr", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert "range" in said
    assert said.count("\n") == 1


@pytest.mark.thorough
def test_a_store_that_changed_is_noticed(server, copied, tmp_path):
    url = f"{server.url}/a.zarr"
    opened = open_store(url)
    opened.episodes[0].read("joint/rows")
    other = write_store(
        tmp_path / "folder.zarr", spec=SPEC, plant_rows=lambda task, episode, tokens, rows: rows[:, ::-1]
    )
    copy_store(open_store(other), tmp_path / "other.zarr", ())
    shutil.rmtree(tmp_path / "served" / "a.zarr")
    shutil.copytree(tmp_path / "other.zarr", tmp_path / "served" / "a.zarr")
    assert read_all(url, tmp_path / "other.zarr") == []
    # What was opened before gives the old numbers or a sentence.
    for name in ("joint/rows", "joint/atoms"):
        with suppress(UserError):
            values = opened.episodes[0].read(name)
            assert np.array_equal(values, open_store(copied).episodes[0].read(name))


@pytest.mark.thorough
def test_a_network_that_fails_later_leaves_no_episode_out(server, tmp_path, capsys):
    """With --skip-corrupt, damage leaves an episode out; a server that fails does not make other numbers."""
    served: list[str] = []

    def fail_later(path: str, content: bytes) -> bytes:
        served.append(path)
        if len([one for one in served if "/episodes/" in one]) > 3:
            server.status = 503
        return content

    server.change = fail_later
    assert analyze([f"{server.url}/a.zarr", "--no-plots", "--skip-corrupt", "--output", str(tmp_path / "out")]) == 2
    assert "a.zarr" in capsys.readouterr().err
    assert not results(tmp_path / "out")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("s3://bucket/a.zarr/", StoreUrl("s3://bucket/a.zarr")),
        (Path("https://host/x/a.zarr"), StoreUrl("https://host/x/a.zarr")),
        ("hf://datasets/org/name/a.zarr", StoreUrl("hf://datasets/org/name/a.zarr")),
        ("file:///tmp/a.zarr", Path("/tmp/a.zarr")),
        ("results/a.zarr", Path("results/a.zarr")),
        ("a:b.zarr", Path("a:b.zarr")),
        ("C:/stores/a.zarr", Path("C:/stores/a.zarr")),
    ],
)
def test_addresses(given, expected):
    assert store_place(given) == expected


def test_an_address_with_a_password_is_refused_and_not_repeated(capsys):
    assert analyze(["https://user:secret@host/x/a.zarr", "--list"]) == 2
    said = capsys.readouterr().err
    assert "host" in said
    assert "secret" not in said


@pytest.mark.parametrize("link", ["https://host/x/a.zarr?signature=secret", "https://host/a.zarr#secret"])
def test_a_signed_link_is_refused_and_not_repeated(link, capsys):
    assert analyze([link, "--list"]) == 2
    said = capsys.readouterr().err
    assert "query" in said
    assert "secret" not in said
    assert said.count("\n") == 1
