"""Stores with effects: the same run as without, the same numbers as reruns, and nothing missing in silence."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import vla_attention as va
from tests.capture.rerun.conftest import capture
from tests.capture.rerun.conftest import pi_store as pi_store
from tests.kit.stores import reseal
from vla_attention.capture.__main__ import main
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.verify import verify_store

EFFECTS = ("--effects", "text,cameras", "--effects-readers", "all", "action", "pictures", "text")


#: Two groups of two selectors; of the second one no task but the first has a key.
GROUPS = """
[groups]
sight = "role:image"
start = ["role:bos", "role:template"]
first = ["word:lift", "object:elsewhere"]
rest = "*"
"""


@pytest.fixture(scope="module")
def with_effects(tmp_path_factory) -> Path:
    return capture(tmp_path_factory.mktemp("effects") / "pi.zarr", "pi", *EFFECTS)


@pytest.fixture(scope="module")
def with_groups(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("groups")
    (folder / "mine.toml").write_text(GROUPS)
    return capture(folder / "pi.zarr", "pi", "--effects", f"cameras,grouping:{folder / 'mine.toml'}")


def changes(store: Store, condition: str) -> dict[str, np.ndarray]:
    """Episode -> changes of the environment's actions (replan, horizon, action dim) under a condition."""
    found = {}
    for episode in store.episodes:
        effects = episode.attributes.effects
        (number,) = [i for i, one in enumerate(effects.conditions) if one.name == condition] or [-1]
        entries = np.flatnonzero(np.array(effects.condition) == number)
        if entries.size:
            assert [effects.replan[entry] for entry in entries] == list(range(episode.attributes.num_replans))
            found[episode.name] = episode.read("effects/change")[entries] * np.array(effects.units)
    return found


def adds_alone(plain: Path, other: Path, added: set[str]) -> None:
    """A store is whole, and has the arrays of another one to the bit, and some more."""
    assert verify_store(open_store(other)) == []
    for mine, theirs in zip(open_store(plain).episodes, open_store(other).episodes, strict=True):
        for name in mine.attributes.arrays:
            assert mine.attributes.arrays[name] == theirs.attributes.arrays[name], name
        assert set(theirs.attributes.arrays) - set(mine.attributes.arrays) == added


def test_the_robot_executes_what_it_would_without_them(pi_store, with_effects):
    adds_alone(pi_store, with_effects, {"effects/change", "joint/cut"})


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("without_word_cube_queries_all", ["--knockout", 'word:"cube"']),
        ("only_visual", ["--keep", "role:image", "--knockout-queries", "action"]),
        (
            "without_instruction_queries_prefix_of_role_image",
            ["--knockout", "role:instruction", "--knockout-queries", "prefix:role:image"],
        ),
        ("base_0_rgb_blank", ["--image", "base_0_rgb=blank"]),
    ],
)
def test_a_rerun_of_one_condition_gives_the_same(with_effects, tmp_path, condition, words):
    target = tmp_path / "one.zarr"
    given = ["rerun", str(with_effects), "--output", str(target), "--check", "0", "--num-episodes", "1"]
    assert main([*given, *words]) == 0
    recorded = changes(open_store(with_effects), condition)
    rerun = open_store(target)
    assert len(recorded) == 2 * len(rerun.episodes) == 4
    for episode in rerun.episodes:
        expected = episode.read("actions") - episode.read("base_actions")
        np.testing.assert_allclose(recorded[episode.name], expected, atol=1e-5)


def test_groups_are_cut_kept_and_controlled(with_groups, tmp_path):
    """A group that is an item already is measured once, with its random keys; the rest is no group."""
    store = open_store(with_groups)
    recorded = store.attributes.recording.effects
    assert list(recorded.groups) == ["sight", "start", "first"]
    for episode in store.episodes:
        names = [one.name for one in episode.attributes.effects.conditions]
        assert len(set(names)) == len(names)
        of_groups = {name.removesuffix("_queries_all") for name in names if "group" in name or "visual" in name}
        alone = {f"{kind}_group_{name}" for kind in ("without", "only", "random") for name in ("start", "first")}
        assert of_groups == {*alone, "without_visual", "only_visual", "random_visual"}
    selector = recorded.groups["start"]
    options = {
        "without_group_start_queries_all": ["--knockout", selector],
        "only_group_start": ["--keep", selector, "--knockout-queries", "action"],
        "random_group_start_queries_all": ["--knockout", selector, "--random-keys", str(recorded.seed)],
    }
    for condition, words in options.items():
        target = tmp_path / f"{condition}.zarr"
        given = ["rerun", str(with_groups), "--output", str(target), "--check", "0", "--num-episodes", "1"]
        assert main([*given, *words]) == 0
        for episode in open_store(target).episodes:
            expected = episode.read("actions") - episode.read("base_actions")
            np.testing.assert_allclose(changes(store, condition)[episode.name], expected, atol=1e-5)


def test_items_of_groups_have_their_names(with_groups):
    rows = va.open(with_groups).effects()["effects_items"]
    kinds = dict(rows.select("label", "item_kind").iter_rows())
    assert kinds["start"] == "group"
    assert kinds["all pictures"] == "pictures"


def test_a_group_that_no_task_has_is_refused_before_the_first_episode(tmp_path, capsys):
    (tmp_path / "typo.toml").write_text('[groups]\na = "word:lifft"\nb = "role:image"\n')
    words = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--output", str(tmp_path / "a.zarr")]
    assert main([*words, "--effects", f"grouping:{tmp_path / 'typo.toml'}"]) == 2
    assert "lifft" in capsys.readouterr().err
    assert not (tmp_path / "a.zarr").exists()


def test_a_rerun_adds_effects_to_stored_calls(pi_store, with_effects, tmp_path):
    target = tmp_path / "later.zarr"
    words = ["rerun", str(pi_store), "--check", "0", "--num-episodes", "1", "--output", str(target)]
    assert main([*words, *EFFECTS]) == 0
    later, now = open_store(target), open_store(with_effects)
    assert verify_store(later) == []
    for name in ("without_word_cube_queries_all", "noise", "only_linguistic"):
        mine, theirs = changes(later, name), changes(now, name)
        assert len(mine) == 2
        for episode in mine:
            np.testing.assert_allclose(mine[episode], theirs[episode], atol=1e-6)


def test_a_rerun_of_changed_attention_is_refused(pi_store, tmp_path, capsys):
    """The base's interventions are made again; an effect would be that of an item on top of them."""
    cut = tmp_path / "cut.zarr"
    words = ["rerun", str(pi_store), "--check", "0", "--num-episodes", "1"]
    assert main([*words, "--output", str(cut), "--knockout", "role:image"]) == 0
    assert main(["rerun", str(cut), "--check", "0", "--output", str(tmp_path / "a.zarr"), "--effects", "text"]) == 2
    assert "interventions" in capsys.readouterr().err
    assert not (tmp_path / "a.zarr").exists()


def test_resume_continues_and_another_choice_is_another_run(with_effects, tmp_path, capsys):
    path = shutil.copytree(with_effects, tmp_path / "pi.zarr")
    words = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", "0", "1"]
    words += ["--num-episodes", "2", "--max-steps", "12", "--output", str(path), "--resume"]
    assert main([*words, *EFFECTS]) == 0
    assert main([*words, "--effects", "text"]) == 2
    assert "recording.effects" in capsys.readouterr().err


def damaged(path: Path, edit) -> list[str]:
    """What verify says of a store whose first episode's attributes were changed and sealed anew."""
    folder = sorted((path / "episodes").iterdir())[1]
    document = json.loads((folder / "zarr.json").read_text())
    edit(document["attributes"])
    (folder / "zarr.json").write_text(json.dumps(document))
    reseal(folder)
    return [str(fault) for fault in verify_store(open_store(path))]


def test_verify_finds_effects_that_do_not_fit(with_effects, tmp_path):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(with_effects, copy)
    faults = damaged(copy, lambda attributes: attributes["effects"]["units"].append(1.0))
    assert any("effects/change" in fault for fault in faults), faults
