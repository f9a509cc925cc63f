"""What lies among the episodes and is none is named and ignored, by every command."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.analyze.test_hostile_stores import WORDS
from tests.kit.planted_effects import planted_effects
from tests.kit.site_stores import SiteStoreSpec, write_site_store
from tests.kit.stores import StoreSpec, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True)
NAMED = ": README.md, notes, task000_episode007, task0_episode1, task1\\x1b;"
EPISODES = [f"task00{task}_episode00{episode}" for task in (0, 1) for episode in (0, 1)]


def add_strays(store: Path) -> None:
    episodes = store / "episodes"
    (episodes / "notes").mkdir()
    (episodes / "notes" / "zarr.json").write_text("{}")
    (episodes / "task0_episode1").mkdir()
    (episodes / "task1\x1b").mkdir()
    (episodes / "README.md").write_text("mine")
    (episodes / "task000_episode007").write_text("a file")


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> Path:
    """With strays: a.zarr, another of the same run, two parts of a run, one with effects, one of a data set."""
    folder = tmp_path_factory.mktemp("strays")
    store = write_store(folder / "a.zarr", spec=SPEC)
    for name in ("other", "one", "two"):
        shutil.copytree(store, folder / f"{name}.zarr")
    for name, left in (("one", 0), ("two", 1)):
        for episode in (folder / f"{name}.zarr/episodes").glob(f"task00{left}_*"):
            shutil.rmtree(episode)
    write_store(folder / "effects.zarr", spec=SPEC, plant_effects=planted_effects())
    write_site_store(folder / "data.zarr", SiteStoreSpec(dataset_actions=0.5, protocol="dataset"))
    for path in folder.glob("*.zarr"):
        add_strays(path)
    return folder


@pytest.fixture(scope="module")
def store(stores) -> Path:
    return stores / "a.zarr"


#: The stores of a command that takes others than a.zarr, or two.
STORES = {
    "effects": ("effects",),
    "effects of data": ("data",),
    "store copy": ("one", "two"),
    "overlay": ("one", "two"),
}
#: Commands that draw unless they are told not to.
DRAWING = ("analyze", "words", "objects", "effects", "effects of data", "overlay")
#: `verify` names strays in its own way.
READING = [command for command in WORDS if command != "store verify"]


@pytest.mark.parametrize("command", thorough_except(("analyze list", "words", "store copy"), READING))
def test_a_command_names_them_and_goes_on(stores, tmp_path, monkeypatch, capsys, command):
    monkeypatch.setenv("VLA_CACHE", "off")
    first, second = (*STORES.get(command, ("a", "other")), "")[:2]
    words = {"STORE": str(stores / f"{first}.zarr"), "OTHER": str(stores / f"{second}.zarr")}
    given = [words.get(word, word).replace("OUT", str(tmp_path / "out")) for word in WORDS[command]]
    given = [word for word in given if word != "--save-viz"] + ["--no-plots"] * (command in DRAWING)
    name = command.split()[0]
    assert analyze([name, *given]) == 0
    said = capsys.readouterr().err
    for path in {word for word in given if word in words.values()}:
        (line,) = [line for line in said.splitlines() if f" {path}, " in line]
        assert line.startswith(f"vla-attention {name}: ")
        assert NAMED in line
        # What view writes is for others, who do not need to know where the store was.
        said_in = ("result.json",) if command == "view" else ("result.json", "*.html")
        for file in (file for name in said_in for file in (tmp_path / "out").rglob(name)):
            assert f" {path}, " in file.read_text(), file


def test_the_library_warns(store):
    with pytest.warns(Note):
        opened = open_store(store)
    assert [episode.name for episode in opened.episodes] == EPISODES


def test_a_copy_leaves_them_behind(store, tmp_path):
    assert analyze(["store", "copy", str(store), str(tmp_path / "copy.zarr")]) == 0
    assert sorted(entry.name for entry in (tmp_path / "copy.zarr/episodes").iterdir()) == [*EPISODES, "zarr.json"]
