"""What lies among the episodes and is none is named and ignored, by every command."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.analyze.test_hostile_stores import WORDS
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True)
NAMED = "among its episodes: README.md, notes, task000_episode007, task0_episode1, task1\\x1b; they are no episodes."
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
def store(tmp_path_factory) -> Path:
    path = write_store(tmp_path_factory.mktemp("strays") / "a.zarr", spec=SPEC)
    add_strays(path)
    return path


@pytest.mark.parametrize("command", ["ratios", "groups", "export", "copy"])
def test_a_command_names_them_and_goes_on(store, tmp_path, monkeypatch, capsys, command):
    monkeypatch.setenv("VLA_CACHE", "off")
    words = {"STORE": str(store), "OTHER": str(store), "OUT": str(tmp_path), "OUT/copy.zarr": str(tmp_path / "c.zarr")}
    given = [words.get(word, word) for word in WORDS[command]]
    given = [word for index, word in enumerate(given) if not (word == str(store) and str(store) in given[:index])]
    assert analyze([command, *given]) == 0
    said = capsys.readouterr().err
    assert said.count(NAMED) == 1
    assert said.startswith(f"vla-analyze {command}: Ignored in {store}, ")


def test_capture_status_names_them(store, capsys):
    assert capture(["status", str(store)]) == 0
    said = capsys.readouterr()
    assert said.err.count(NAMED) == 1
    assert "4 episodes of 2 tasks" in said.out


def test_the_library_warns(store):
    with pytest.warns(Note, match="they are no episodes"):
        opened = open_store(store)
    assert [episode.name for episode in opened.episodes] == EPISODES


def test_a_copy_leaves_them_behind(store, tmp_path):
    assert analyze(["copy", str(store), str(tmp_path / "copy.zarr")]) == 0
    assert sorted(entry.name for entry in (tmp_path / "copy.zarr/episodes").iterdir()) == [*EPISODES, "zarr.json"]
