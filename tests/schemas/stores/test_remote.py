"""Stores at an address: only what a question needs is sent, once, and what a server sends wrongly is never a number."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra remote: pip install 'vla-attention[remote]'")

from fsspec.asyn import AsyncFileSystem

from tests.kit.http_ranges import Served, serve
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.words.word_study import study_words
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores import bounded_fetch, remote_source
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.remote_source import KeptBytes, RemoteFailure
from vla_attention.schemas.stores.store_url import StoreUrl, store_place
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, write_store

pytestmark = pytest.mark.filterwarnings("ignore:Whether the index.json")

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2)
DEEP = StoreSpec(
    tasks=(0,), episodes=1, replans=6, layers=tuple(range(18)), num_layers=18, heads=tuple(range(8)), queries="all"
)


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("packed")
    copy_store(open_store(write_store(made / "folder.zarr", spec=SPEC)), made / "a.zarr", (), packed=True)
    return made / "a.zarr"


@pytest.fixture
def server(packed, tmp_path) -> Iterator[Served]:
    shutil.copytree(packed, tmp_path / "served" / "a.zarr")
    with serve(tmp_path / "served") as served:
        yield served


@pytest.fixture
def kept(tmp_path, monkeypatch) -> Path:
    """A folder for what was fetched."""
    monkeypatch.setenv("VLA_REMOTE_CACHE", str(tmp_path / "kept"))
    return tmp_path / "kept"


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


def one_sentence(said: str) -> str:
    """What a command printed beside the note on what a web server cannot be asked: one line."""
    lines = [line for line in said.splitlines() if "lists every episode of it was not checked" not in line]
    assert len(lines) == 1, said
    return lines[0]


def check_silence(said: str, url: str, seconds: float) -> None:
    """Fail unless a sentence says that a server was silent for as long as it may be; a busy machine notices later."""
    found = re.search(rf"{re.escape(url)} cannot be read: its server sent nothing for ([0-9]+\.[0-9]) s\.", said)
    assert found, said
    assert seconds <= float(found[1]) < 20


def results(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.suffix in (".csv", ".json", ".txt")
    }


def test_a_store_is_read_by_its_address(server, packed):
    store = open_store(f"{server.url}/a.zarr")
    assert store.path == StoreUrl(f"{server.url}/a.zarr")
    assert [episode.name for episode in store.episodes] == [episode.name for episode in open_store(packed).episodes]
    assert read_all(f"{server.url}/a.zarr", packed) == []
    assert verify_store(store) == []


def test_commands_take_addresses(server, packed, tmp_path, capsys):
    url = f"{server.url}/a.zarr"
    for place in (url, str(packed)):
        out = tmp_path / f"out{place == url}"
        assert analyze([place, "--no-plots", "--output", str(out)]) == 0, capsys.readouterr().err
    text = {
        place: {name: content.replace(place.encode(), b"STORE") for name, content in results(folder).items()}
        for place, folder in ((url, tmp_path / "outTrue"), (str(packed), tmp_path / "outFalse"))
    }
    assert text[url] == text[str(packed)] != {}
    assert analyze(["verify", url]) == 0
    assert analyze([url, "--list"]) == 0
    assert analyze(["copy", url]) == 0
    assert analyze(["copy", url, str(tmp_path / "c.zarr")]) == 0
    assert verify_store(open_store(tmp_path / "c.zarr")) == []


@pytest.mark.parametrize("words", [("--list",), ("--no-plots", "--no-cache")], ids=["list", "masses"])
def test_several_episodes_are_opened_at_once(tmp_path, words):
    made = write_store(tmp_path / "folder.zarr", spec=StoreSpec(tasks=(0,), episodes=3, replans=2))
    copy_store(open_store(made), tmp_path / "served" / "a.zarr", (), packed=True)
    both = threading.Barrier(2, timeout=20)
    waited: set[str] = set()

    def meet(path: str, content: bytes) -> bytes:
        # The first episode may be looked at alone: the store's root is compared with its seal.
        if path.endswith(("episode001.zip", "episode002.zip")) and path not in waited:
            waited.add(path)
            both.wait()  # breaks when the other episode is asked for only after the answer
        return content

    with serve(tmp_path / "served") as served:
        served.change = meet
        assert analyze([f"{served.url}/a.zarr", "--output", str(tmp_path / "out"), *words]) == 0
    assert len(waited) == 2
    assert not both.broken


def test_workers_read_addresses(server, tmp_path, capsys):
    url = f"{server.url}/a.zarr"
    for workers in ("1", "2"):
        words = [url, "--no-plots", "--output", str(tmp_path / workers), "--workers", workers]
        assert analyze(words) == 0, capsys.readouterr().err
    assert results(tmp_path / "1") == results(tmp_path / "2") != {}


def test_three_layers_of_eighteen_send_at_most_a_quarter(tmp_path):
    made = write_store(tmp_path / "folder.zarr", spec=DEEP, frames=False)
    copy_store(open_store(made), tmp_path / "served" / "a.zarr", (), packed=True)
    with serve(tmp_path / "served") as served:
        url = f"{served.url}/a.zarr"
        episode = open_store(url).episodes[0]
        for name in episode.attributes.arrays:
            episode.read(name)
        everything = served.of_episodes()
        served.forget()
        settings = AnalysisSettings(layers=(0, 8, 17))
        remote = study_words([open_store(url)], settings, 0)
        assert 0 < served.of_episodes() <= everything / 4, (served.sent, everything)
    assert remote.episodes.whole.equals(study_words([open_store(made)], settings, 0).episodes.whole)


def test_a_command_says_that_a_web_server_does_not_say_what_it_has(server, packed, tmp_path, capsys):
    """Its index may lack an episode: here `verify` finds it, there nobody does."""
    index = tmp_path / "served" / "a.zarr" / INDEX_FILE
    document = json.loads(index.read_text())
    del document["episodes"]["task000_episode001"]
    index.write_text(json.dumps(document | {"digest": seal_digest(document)}))
    url = f"{server.url}/a.zarr"
    reason = "was not checked: a web server lists no files below a folder"
    assert analyze(["verify", url]) == 0
    said = capsys.readouterr()
    assert f"{url}: index.json: whether it lists every episode {reason}" in said.out
    assert said.err == ""
    assert analyze(["verify", url, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["unchecked"] == [
        f"index.json: whether it lists every episode {reason}"
    ]
    assert analyze([url, "--list"]) == 0
    assert f"Whether the index.json of {url} lists every episode of it {reason}.\n" in capsys.readouterr().err
    assert analyze(["verify", str(index.parent)]) == 1


def test_what_was_fetched_is_not_sent_again(server, kept, tmp_path):
    url = f"{server.url}/a.zarr"
    found = []
    for _ in range(2):
        server.forget()
        out = tmp_path / f"out{len(found)}"
        assert analyze([url, "--no-plots", "--output", str(out)]) == 0
        found.append((server.of_episodes(), results(out)))
    assert found[0][0] > 0
    assert found[1][0] == 0
    assert found[0][1] == found[1][1]
    # The root and the index are asked for each time: a changed store is noticed.
    assert {path.rpartition("/")[2] for path, _ in server.requests} <= {"zarr.json", INDEX_FILE}


def test_without_a_folder_for_it_nothing_is_kept(server, tmp_path):
    for _ in range(2):
        server.forget()
        open_store(f"{server.url}/a.zarr").episodes[0].read("joint/rows")
        assert server.of_episodes() > 0


def test_what_was_fetched_is_kept_in_no_store(server, packed, tmp_path, monkeypatch, capsys):
    shutil.copytree(packed, tmp_path / "b.zarr")
    monkeypatch.setenv("VLA_REMOTE_CACHE", str(tmp_path / "b.zarr" / "kept"))
    assert analyze([f"{server.url}/a.zarr", "--list"]) == 2
    assert f"is inside of the store {tmp_path / 'b.zarr'}" in one_sentence(capsys.readouterr().err)
    assert not (tmp_path / "b.zarr" / "kept").exists()


def test_damaged_bytes_of_the_cache_are_fetched_again(server, kept, packed):
    url = f"{server.url}/a.zarr"
    assert read_all(url, packed) == []
    files = [file for file in kept.rglob("*") if file.is_file()]
    assert files
    for change in (
        lambda content: content[:-1],
        lambda content: b"",
        lambda content: content[:40] + b"x" + content[41:],
    ):
        for file in kept.rglob("*"):
            if file.is_file():
                file.write_bytes(change(file.read_bytes()))
        assert read_all(url, packed) == []


def test_a_cache_that_holds_other_bytes_with_right_digests_is_no_number(server, kept, packed):
    """Bytes of other requests under each name, as a foreign program might leave them: the seal decides."""
    url = f"{server.url}/a.zarr"
    assert read_all(url, packed) == []
    files = sorted(file for file in kept.rglob("*") if file.is_file())
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, contents[1:] + contents[:1], strict=True):
        file.write_bytes(content)
    assert read_all(url, packed) == []


def test_the_cache_stays_below_its_size(tmp_path):
    kept = KeptBytes(tmp_path / "kept", 10_000)
    for i in range(50):
        kept.put(str(i), bytes([i]) * 1000)
    total = sum(file.stat().st_size for file in (tmp_path / "kept").rglob("*") if file.is_file())
    assert 0 < total <= 2 * 10_000
    assert kept.get("49") in (None, bytes([49]) * 1000)


@pytest.mark.parametrize("cached", [False, True])
def test_damaged_answers_are_never_a_number(server, packed, cached, request):
    if cached:
        request.getfixturevalue("kept")
    url = f"{server.url}/a.zarr"
    generator = np.random.default_rng(0)

    def flip(path: str, content: bytes) -> bytes:
        if not path.endswith(".zip"):
            return content
        at = int(generator.integers(len(content)))
        return content[:at] + bytes([content[at] ^ 0x20]) + content[at + 1 :]

    server.change = flip
    for _ in range(3):
        assert read_all(url, packed)
    server.change = None
    assert read_all(url, packed) == []  # nothing wrong was kept


@pytest.mark.parametrize("announce", [False, True])
def test_short_answers_are_never_a_number(server, packed, announce):
    url = f"{server.url}/a.zarr"
    for keep in (0, 1, 0.5):
        server.announce = announce
        server.change = lambda path, content, keep=keep: content[: int(len(content) * keep) if keep < 1 else -1]
        assert read_all(url, packed)
        server.change = lambda path, content, keep=keep: (
            content[: int(len(content) * keep) if keep < 1 else -1] if path.endswith(".zip") else content
        )
        assert read_all(url, packed)


def test_an_answer_of_another_place_is_never_a_number(server, packed):
    """A proxy that answers every part with the beginning of the file."""
    whole = {f"a.zarr/{file.relative_to(packed)}": file.read_bytes() for file in packed.rglob("*.zip")}
    server.change = lambda path, content: whole[path][: len(content)] if path in whole else content
    assert read_all(f"{server.url}/a.zarr", packed)


@pytest.mark.parametrize(("file", "most"), [("zarr.json", "4,000,000"), ("index.json", "32,000,000")])
def test_no_more_is_read_than_a_file_may_have(server, packed, file, most):
    """A server that goes on sending; it is not asked how much there is."""
    server.change = lambda path, content: b" " * 40_000_000 if path.endswith(f"a.zarr/{file}") else content
    (problem,) = read_all(f"{server.url}/a.zarr", packed)
    assert f"a.zarr/{file} has more than the {most} bytes that such a file has at most" in problem


def test_a_server_without_ranges_is_refused_with_a_sentence(server, packed, capsys):
    server.ranges = False
    assert "range requests" in " ".join(read_all(f"{server.url}/a.zarr", packed))
    assert analyze([f"{server.url}/a.zarr", "--no-plots"]) == 2
    assert "range requests" in one_sentence(capsys.readouterr().err)


@pytest.mark.parametrize("cached", [False, True])
def test_a_store_that_changed_is_noticed(server, packed, tmp_path, cached, request):
    if cached:
        request.getfixturevalue("kept")
    url = f"{server.url}/a.zarr"
    opened = open_store(url)
    opened.episodes[0].read("joint/rows")
    other = write_store(
        tmp_path / "folder.zarr", spec=SPEC, plant_rows=lambda task, episode, tokens, rows: rows[:, ::-1]
    )
    copy_store(open_store(other), tmp_path / "other.zarr", (), packed=True)
    shutil.rmtree(tmp_path / "served" / "a.zarr")
    shutil.copytree(tmp_path / "other.zarr", tmp_path / "served" / "a.zarr")
    assert read_all(url, tmp_path / "other.zarr") == []
    # What was opened before gives the old numbers or a sentence.
    for name in ("joint/rows", "joint/atoms", "joint/row_sum"):
        with suppress(UserError):
            values = opened.episodes[1].read(name)
            assert np.array_equal(values, open_store(packed).episodes[1].read(name))


@pytest.mark.parametrize("status", [401, 403, 404, 429, 500, 503])
def test_a_server_that_refuses_is_a_sentence(server, capsys, status):
    server.status = status
    assert analyze([f"{server.url}/a.zarr", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert server.url in said
    assert said.count("\n") == 1


def test_a_network_that_fails_later_leaves_no_episode_out(server, tmp_path, capsys):
    """With --skip-corrupt, damage leaves an episode out; a server that fails does not make other numbers."""
    served: list[str] = []

    def fail_later(path: str, content: bytes) -> bytes:
        served.append(path)
        if len([one for one in served if one.endswith(".zip")]) > 3:
            server.status = 503
        return content

    server.change = fail_later
    assert analyze([f"{server.url}/a.zarr", "--no-plots", "--skip-corrupt", "--output", str(tmp_path / "out")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert not results(tmp_path / "out")


def test_a_server_that_hangs_is_a_sentence(server, half_a_second, capsys):
    """Not after aiohttp's five minutes: whoever asks, and whoever stops the command, would wait for so long."""
    ended = threading.Event()

    def hang(path: str, content: bytes) -> bytes:
        if path.endswith(".zip"):
            ended.wait(60)
        return content

    server.change = hang
    try:
        assert analyze([f"{server.url}/a.zarr", "--no-plots"]) == 2
        assert not ended.is_set()
    finally:
        ended.set()
    check_silence(one_sentence(capsys.readouterr().err), f"{server.url}/a.zarr", 0.5)


def a_piece_each(seconds: float, piece: bytes, count: int) -> Iterator[bytes]:
    for _ in range(count):
        yield piece
        time.sleep(seconds)


def servers_answer_within(seconds: float, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(remote_source, "ANSWER_WITHIN_S", seconds)
    remote_source._file_system_of.cache_clear()
    yield
    remote_source._file_system_of.cache_clear()


@pytest.fixture
def half_a_second(monkeypatch) -> Iterator[None]:
    """Servers are silent after half a second."""
    yield from servers_answer_within(0.5, monkeypatch)


@pytest.fixture
def two_seconds(monkeypatch) -> Iterator[None]:
    """Servers are silent after two seconds: where some requests have to be answered in time."""
    yield from servers_answer_within(2.0, monkeypatch)


@pytest.mark.parametrize("file", ["zarr.json", INDEX_FILE, "task000_episode000.zip"])
def test_a_server_that_sends_a_byte_now_and_then_is_a_sentence(server, two_seconds, capsys, file):
    """It is never silent: a byte a second would take ten days for a file of a megabyte."""
    given: list[bytes] = []
    ended = threading.Event()

    def drip() -> Iterator[bytes]:
        while len(given) < 2000 and not ended.wait(0.05):
            given.append(b" ")
            yield b" "

    server.pieces = lambda path: drip() if path.endswith(file) else None
    try:
        assert analyze([f"{server.url}/a.zarr", "--no-plots"]) == 2
        assert len(given) < 2000  # the answer had not ended
    finally:
        ended.set()
    said = one_sentence(capsys.readouterr().err)
    assert re.search(
        r"/a.zarr cannot be read: its server sent [0-9]+ bytes in [0-9]+ s; expected at least 10,000 a", said
    )


def test_a_slow_server_is_waited_for(server, packed, two_seconds):
    whole = (packed / INDEX_FILE).read_bytes()
    pieces = [whole[at : at + 40] for at in range(0, len(whole), 40)]

    def slowly() -> Iterator[bytes]:
        yield b" " * 100_000  # ten seconds more
        for piece in pieces:
            time.sleep(2.5 / len(pieces))
            yield piece

    server.pieces = lambda path: slowly() if path.endswith(INDEX_FILE) else None
    assert len(open_store(f"{server.url}/a.zarr").episodes) == 2


def test_a_list_without_an_end_takes_no_memory(server, tmp_path, capsys):
    shutil.copytree(tmp_path / "served" / "a.zarr", tmp_path / "served" / "b.zarr")
    (tmp_path / "served" / "b.zarr" / INDEX_FILE).unlink()
    links = b"".join(b'<a href="task000_episode%05d/">x</a>\n' % number for number in range(25_000))
    server.pieces = lambda path: a_piece_each(0, links, 60) if path.endswith("b.zarr/episodes") else None
    assert analyze([f"{server.url}/b.zarr", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert "its list has more than 16,000,000 bytes" in said
    assert said.count("\n") == 1
    assert server.sent["b.zarr/episodes"] < 40_000_000  # of 66


@pytest.mark.parametrize(
    "page",
    [
        '<a href="../">../</a><a href="task000_episode000/">task000_episode000/</a> <a href="zarr.json">zarr.json</a>',
        "<A HREF='?C=N;O=D'>N</A><A HREF='/a.zarr'>up</A><A HREF='/a.zarr/episodes/task000_episode000/'>x</A>"
        "<A HREF='zarr.json?x=1'>y</A>",
        '<a href="http://127.0.0.1:PORT/a.zarr/episodes/task000_episode000#x">x</a><a href="zarr%2Ejson">x</a>'
        '<a href="https://elsewhere/a.zarr/episodes/task000_episode009/">x</a><a href="http://[">x</a>',
    ],
    ids=["nginx", "Apache", "whole addresses"],
)
def test_the_lists_of_web_servers(server, page):
    shown = page.replace("PORT", server.url.rpartition(":")[2]).encode()
    server.pieces = lambda path: iter([shown]) if path.endswith("/episodes") else None
    folder = remote_source.RemoteFolder(f"{server.url}/a.zarr")
    assert folder.names("episodes") == ["task000_episode000", "zarr.json"]


class Endless:
    """A file system, as those of the hub, whose lists go on page after page."""

    protocol = "endless"

    def ls(self, path: str, detail: bool) -> list[str]:
        time.sleep(20)
        return []


class EndlessAsync(AsyncFileSystem):
    """The same, as those of S3."""

    protocol = "endless"

    async def _ls(self, path: str, detail: bool = True, **_: object) -> list[str]:
        await asyncio.sleep(20)
        return []

    async def _cat_file(self, path: str, start: int | None = None, end: int | None = None, **_: object) -> bytes:
        await asyncio.sleep(20)
        return b""


@pytest.mark.parametrize("kind", [Endless, EndlessAsync])
def test_other_services_have_as_much_time_for_a_list(half_a_second, monkeypatch, kind):
    monkeypatch.setattr(remote_source, "_file_system", lambda url: (kind(), "bucket/a.zarr"))
    with pytest.raises(RemoteFailure) as refused:
        remote_source.RemoteFolder("s3://bucket/a.zarr").names("episodes")
    check_silence(str(refused.value), "s3://bucket/a.zarr", 0.5)


def test_other_services_have_as_much_time_for_a_file(half_a_second, monkeypatch):
    monkeypatch.setattr(remote_source, "_file_system", lambda url: (EndlessAsync(), "bucket/a.zarr"))
    with pytest.raises(RemoteFailure) as refused:
        remote_source.RemoteFolder("s3://bucket/a.zarr").whole("zarr.json", most=1000)
    check_silence(str(refused.value), "s3://bucket/a.zarr", 0.6)  # 1,000 bytes take 0.1 s


def test_a_list_of_a_million_names_is_refused(monkeypatch):
    monkeypatch.setattr(bounded_fetch, "LISTED_NAMES", 3)
    monkeypatch.setattr(Endless, "ls", lambda self, path, detail: [f"{path}/{number}" for number in range(4)])
    monkeypatch.setattr(remote_source, "_file_system", lambda url: (Endless(), "bucket/a.zarr"))
    with pytest.raises(RemoteFailure, match="its list has more than 3 names"):
        remote_source.RemoteFolder("s3://bucket/a.zarr").names("episodes")


def test_nobody_there_is_a_sentence(capsys):
    assert analyze(["http://127.0.0.1:9/a.zarr", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert "http://127.0.0.1:9/a.zarr" in said
    assert said.count("\n") == 1


def test_a_store_of_folders_needs_a_listing(server, tmp_path, capsys):
    shutil.copytree(tmp_path / "served" / "a.zarr", tmp_path / "served" / "b.zarr")
    (tmp_path / "served" / "b.zarr" / INDEX_FILE).unlink()
    assert analyze([f"{server.url}/b.zarr", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert "copy --packed" in said
    assert said.count("\n") == 1


def test_a_hostile_index_asks_for_nothing_outside(server, tmp_path):
    index = tmp_path / "served" / "a.zarr" / INDEX_FILE
    document = json.loads(index.read_text())
    document["episodes"]["task000_episode000"]["file"] = "../../secret"
    index.write_text(json.dumps(document | {"digest": seal_digest(document)}))
    with pytest.raises(UserError):
        open_store(f"{server.url}/a.zarr")
    assert not any("secret" in path for path, _ in server.requests)


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
    assert "The address of host was given with a password" in said
    assert "secret" not in said


@pytest.mark.parametrize("link", ["https://host/x/a.zarr?signature=secret", "https://host/a.zarr#secret"])
def test_a_signed_link_is_refused_and_not_repeated(link, capsys):
    assert analyze([link, "--list"]) == 2
    said = capsys.readouterr().err
    assert "query" in said
    assert "secret" not in said
    assert said.count("\n") == 1


def test_an_unknown_kind_of_address_is_named_once(capsys):
    assert analyze(["foo://host/a.zarr", "--list"]) == 2
    said = capsys.readouterr().err
    assert said.count("foo://host/a.zarr") == 1
    assert said.count("\n") == 1
