"""A store may come from anybody: its names and texts stay text, whatever command shows them."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from tests.kit.planted_effects import planted_effects
from tests.kit.site_stores import SiteStoreSpec, write_site_store
from tests.kit.stores import StoreSpec, reseal, reseal_root, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.published.parse_results import main as parse
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.layout import SiteLayout, Span
from vla_attention.schemas.stores.digest import bytes_digest
from vla_attention.schemas.stores.seal import SEAL_FILE, seal_document

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True)
#: Clears a screen, moves the cursor, reverses the direction of writing, begins a line, is markup, and is a formula.
INSTRUCTION = "put\x1b[2J the\u202e bowl\r\non the plate\x9b31m\u2028 <script>alert('bowl')</script> $x^{$ & \"it\""
#: What a text with line ends tries to add as a line of its own.
FORGED = "FORGED: all whole"
INSTRUCTION += f"\n{FORGED}\x85{FORGED}\x0b{FORGED}"
MARKUP = "<img src=x onerror=alert(1)>"
FORMULA = "$x^{$ <b>%2E"


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def store(original, tmp_path) -> Path:
    path = tmp_path / "stores" / "a.zarr"
    shutil.copytree(original, path)
    return path


def change(document: Path, make: Callable[[dict[str, Any]], object]) -> None:
    """Change the attributes in a zarr.json."""
    content = json.loads(document.read_text())
    make(content["attributes"])
    document.write_text(json.dumps(content))


def change_episodes(store: Path, make: Callable[[dict[str, Any]], object]) -> None:
    for folder in sorted((store / "episodes").glob("task*")):
        change(folder / "zarr.json", make)
        reseal(folder)


def hostile_texts(store: Path) -> None:
    """Texts of every kind that a store may hold, with names that are refused nowhere."""

    def root(attributes: dict[str, Any]) -> None:
        attributes["protocol"]["suite"] = FORMULA
        attributes["policy"] |= {"name": MARKUP, "checkpoint": f"https://x/{MARKUP}"}
        attributes["provenance"] = {
            "code": f"\x1b[2J{MARKUP}\n{FORGED}\n\u202e",
            f"numpy\x1b{MARKUP}\n{FORGED}": "1\x07",
        }

    def episode(attributes: dict[str, Any]) -> None:
        attributes["instruction"] = INSTRUCTION
        attributes["provenance"] = {"host": f"\x1b[2J\n{FORGED}"}
        for prompt in attributes["prompts"]:
            prompt["text"] = prompt["text"].replace("the", "t\x1b\u202e")
        attributes["objects"][0]["name"] = MARKUP
        attributes["objects"][1]["name"] = FORMULA

    change(store / "zarr.json", root)
    reseal_root(store)
    change_episodes(store, episode)


def files_under(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


def all_paths(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def check_output(capsys: pytest.CaptureFixture[str]) -> str:
    """Everything printed since the last call; all of it is printable."""
    captured = capsys.readouterr()
    for line in (captured.out + captured.err).split("\n"):
        assert line.isprintable(), repr(line)
        assert not line.strip().startswith(FORGED), captured
    return captured.out + captured.err


class Tags(HTMLParser):
    """The tags and attributes of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, list[str]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, [name for name, _ in attrs]))


#: Further arguments of each command; OUT is its folder of output.
WORDS: dict[str, tuple[str, ...]] = {
    "analyze": ("STORE", "--output", "OUT", "--save-viz", "--layers", "0"),
    "analyze list": ("STORE", "--list", "--output", "OUT"),
    "analyze by": ("STORE", "--by", "head,time", "--csv", "--output", "OUT"),
    "words": ("STORE", "--output", "OUT", "--task", "0"),
    "objects": ("STORE", "--output", "OUT"),
    "compare": ("STORE", "OTHER", "--output", "OUT", "--no-plots"),
    "effects": ("STORE", "--output", "OUT"),
    "effects of data": ("STORE", "--output", "OUT"),
    "overlay": ("STORE", "OTHER", "--output", "OUT"),
    "report": ("STORE", "--output", "OUT", "--num-episodes", "1", "--task", "0", "--layers", "0"),
    "view": ("STORE", "--site", "OUT"),
    "store copy": ("copy", "STORE", "OUT/copy.zarr", "--without", "frames"),
    "store verify": ("verify", "STORE"),
}


@pytest.mark.drawn
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("command", thorough_except(("analyze", "report"), WORDS))
def test_hostile_texts_are_printed_visibly_and_nothing_is_written_elsewhere(
    store, tmp_path, monkeypatch, capsys, command
):
    if command == "effects of data":  # of a store with the actions of a data set
        shutil.rmtree(store)
        write_site_store(store, HostileSites(dataset_actions=0.5, protocol="dataset"))
    else:
        if command == "effects":
            shutil.rmtree(store)
            write_store(store, spec=replace(SPEC, plant_effects=planted_effects()))
        hostile_texts(store)
    other = write_store(tmp_path / "stores" / "b.zarr", spec=SPEC, suite="other")
    if command == "compare":
        shutil.rmtree(other)
        shutil.copytree(store, other)
    out = tmp_path / "out"
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    if command == "overlay":  # of stores of one run
        change(other / "zarr.json", lambda root: root["policy"].update(name=MARKUP))
        for folder in (other / "episodes").glob("task*"):
            reseal(folder)
    before = files_under(tmp_path)
    given = [
        word.replace("STORE", str(store)).replace("OTHER", str(other)).replace("OUT", str(out))
        for word in WORDS[command]
    ]
    code = analyze([command.split()[0], *given])
    printed = check_output(capsys)
    assert code == 0, printed
    assert all(out in path.parents for path in files_under(tmp_path) - before)
    for path in files_under(out):
        assert path.relative_to(out).as_posix().isprintable()
        if path.suffix in (".txt", ".csv", ".html"):
            for line in path.read_text(encoding="utf-8").split("\n"):
                assert line.isprintable(), (path.name, line)
                assert not line.strip().startswith(FORGED), (path.name, line)
    if command == "analyze":
        assert r"put\x1b[2J the\u202e" in printed
        assert (out / "attention_ratio_results_%24x%5E%7B%24 %3Cb%3E%252E.json").is_file()
        assert parse(["--results", str(out), "--output", str(out / "parsed.txt")]) == 0
        assert r"put\x1b[2J the\u202e" in check_output(capsys)
    if command == "report":
        page = (out / "report.html").read_text(encoding="utf-8")
        tags = Tags()
        tags.feed(page)
        assert not [tag for tag in tags.tags if any(name.startswith("on") for name in tag[1])]
        assert sum(tag == "script" for tag, _ in tags.tags) == 1
        assert MARKUP not in page
        assert "&lt;img src=x onerror=alert(1)&gt;" in page


@pytest.mark.parametrize("command", [command for command, words in WORDS.items() if "OUT" in " ".join(words)])
@pytest.mark.parametrize("inside", ["", "episodes/task000_episode000/new"])
def test_no_command_writes_into_a_store(original, store, tmp_path, capsys, command, inside):
    """Readers would take what lies there for a part of the store, and a second analysis for a damaged one."""
    other, before = tmp_path / "stores" / "b.zarr", all_paths(store)
    shutil.copytree(original, other)
    (tmp_path / "link").symlink_to(store)
    out = tmp_path / "link" / inside
    words = [word.replace("STORE", str(store)).replace("OTHER", str(other)) for word in WORDS[command]]
    try:
        code: object = analyze([command.split()[0], *(word.replace("OUT", str(out)) for word in words)])
    except SystemExit as end:  # of a mistake in the arguments
        code = end.code
    assert code == 2
    said = check_output(capsys)
    assert str(store) in said, said
    assert said.count("\n") == 1
    assert all_paths(store) == before


@pytest.mark.parametrize("given", [None, "cache"])
def test_the_cache_is_in_no_store(store, tmp_path, monkeypatch, capsys, given):
    monkeypatch.chdir(store)
    monkeypatch.delenv("VLA_CACHE", raising=False)
    if given is not None:
        monkeypatch.setenv("VLA_CACHE", str(store / given))
        monkeypatch.chdir(tmp_path)
    before = all_paths(store)
    words = [str(store), "--no-plots", "--output", str(tmp_path / "out")]
    assert analyze(words) == 2
    what = "what VLA_CACHE names, " if given else "the working directory's cache "
    assert f"{what}{store}" in check_output(capsys)
    assert all_paths(store) == before
    assert analyze([*words, "--no-cache"]) == 0


@dataclass(frozen=True)
class HostileSites(SiteStoreSpec):
    """Sites, spans and cameras whose names are markup and a formula."""

    @property
    def sites(self) -> tuple[SiteLayout, ...]:
        def named(span: Span) -> Span:
            return (
                span
                if span.camera is None
                else structs.replace(span, name=MARKUP + span.name, camera=MARKUP + span.name)
            )

        made = zip((FORMULA, MARKUP), super().sites, strict=True)
        return tuple(structs.replace(site, name=name, spans=tuple(map(named, site.spans))) for name, site in made)


@pytest.mark.thorough
@pytest.mark.drawn
@pytest.mark.parametrize(
    "command", thorough_except(("analyze",), sorted(set(WORDS) - {"effects", "objects", "compare", "merge"}))
)
def test_hostile_names_of_sites_are_printed_visibly_and_nothing_is_written_elsewhere(tmp_path, capsys, command):
    store = write_site_store(tmp_path / "a.zarr", HostileSites(kind="split", dataset_actions=0.5, outcome="some"))
    out, before = tmp_path / "out", files_under(tmp_path)
    words = [word for word in WORDS[command] if word != "OTHER"]
    assert (
        analyze([command.split()[0], *(word.replace("STORE", str(store)).replace("OUT", str(out)) for word in words)])
        == 0
    )
    check_output(capsys)
    assert analyze([str(store), "--list"]) == 0
    assert FORMULA in check_output(capsys)
    assert all(out in path.parents for path in files_under(tmp_path) - before)
    if command == "report":
        page = (out / "report.html").read_text(encoding="utf-8")
        tags = Tags()
        tags.feed(page)
        assert not [tag for tag in tags.tags if any(name.startswith("on") for name in tag[1])]
        assert MARKUP not in page


def test_the_list_of_a_store_and_its_status_are_visible(store, capsys):
    hostile_texts(store)
    assert analyze([str(store), "--list"]) == 0
    assert r"put\x1b[2J the\u202e bowl\r\non the plate\x9b31m\u2028" in check_output(capsys)
    assert capture(["status", str(store)]) == 0
    assert r"put\x1b[2J the\u202e bowl\r\non" in check_output(capsys)


def set_suite(root: dict[str, Any], name: str) -> None:
    root["protocol"]["suite"] = name


def set_camera(root: dict[str, Any], name: str) -> None:
    root["sites"][0]["spans"][0]["camera"] = name


def set_view(root: dict[str, Any], name: str) -> None:
    root["policy"]["cameras"][0]["name"] = name


def set_span(root: dict[str, Any], name: str) -> None:
    root["sites"][0]["spans"][0]["name"] = name


def set_site(root: dict[str, Any], name: str) -> None:
    root["sites"][0]["name"] = name


def set_policy(root: dict[str, Any], name: str) -> None:
    root["policy"]["name"] = name


def set_object(episode: dict[str, Any], name: str) -> None:
    episode["objects"][0]["name"] = name


def set_array(episode: dict[str, Any], name: str) -> None:
    episode["arrays"][name] = episode["arrays"].pop("frames/base_0_rgb")


def set_task(episode: dict[str, Any], name: str) -> None:
    episode["task_name"] = name


CONTROL, PATH = "a\x1b[2J\u202e", "../../../x"


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *itertools.product([set_suite, set_camera, set_view, set_span, set_site], [PATH, CONTROL]),
        (set_policy, CONTROL),
        (set_site, "seal"),
    ],
)
def test_a_run_whose_names_are_paths_or_control_a_terminal_is_refused(store, tmp_path, capsys, make, name):
    change(store / "zarr.json", lambda attributes: make(attributes, name))
    before = files_under(tmp_path)
    for command in ((), ("store", "verify"), ("words",), ("report",)):
        more = () if "verify" in command else ("--output", str(tmp_path / "out"))
        assert analyze([*command, str(store), *more]) == 2
        assert str(store) in check_output(capsys)
    assert capture(["status", str(store)]) == 2
    check_output(capsys)
    assert files_under(tmp_path) == before


@pytest.mark.parametrize("name", [PATH, CONTROL])
@pytest.mark.parametrize("make", [set_object, set_array, set_task])
def test_an_episode_whose_names_are_paths_or_control_a_terminal_is_refused(store, tmp_path, capsys, make, name):
    change_episodes(store, lambda attributes: make(attributes, name))
    before = files_under(tmp_path)
    assert analyze([str(store), "--output", str(tmp_path / "out")]) == 2
    assert "attributes" in check_output(capsys)
    assert analyze(["store", "copy", str(store), str(tmp_path / "copy.zarr")]) == 2
    check_output(capsys)
    assert analyze(["store", "verify", str(store)]) == 1
    check_output(capsys)
    assert not {path for path in files_under(tmp_path) - before if path.name != "zarr.json"}


def test_a_seal_that_lists_files_outside_of_its_episode_copies_none(store, tmp_path, capsys):
    (tmp_path / "secret").write_text("secret")
    folder = store / "episodes" / "task000_episode000"
    outside = "../../../../secret"

    seal = json.loads((folder / SEAL_FILE).read_text())["attributes"]
    seal["files"][outside] = {"size": 6, "sha256": bytes_digest(b"secret"), "index": "", "chunks": ""}
    (folder / SEAL_FILE).write_bytes(seal_document(seal))
    assert analyze(["store", "copy", str(store), str(tmp_path / "deep" / "er" / "copy.zarr")]) == 2
    assert "seal" in check_output(capsys)
    assert list(tmp_path.rglob("secret")) == [tmp_path / "secret"]
