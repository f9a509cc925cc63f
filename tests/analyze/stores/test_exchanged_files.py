"""Files in the wrong place and edited roots: a question has its right answer, or an error that names the episode."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from math import gcd
from pathlib import Path

import polars as pl
import pytest

import vla_attention as va
from tests.kit.attacks import attacks, edit_root, first, flip_bit, root_leaves
from tests.kit.stores import StoreSpec, every_key_seen, reseal_root, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.api import OpenStores
from vla_attention.analyze.core.result import Result
from vla_attention.analyze.store.copying import copy_store
from vla_attention.capture.store import site_writer
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.schemas.stores.verify import verify_store

#: Both episodes of a task have arrays of the same shapes; rows are in three blocks.
SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=9, contributions=True, prompts="same", plant_uniform=every_key_seen)
ARRAYS = (
    *(f"joint/{name}" for name in ("atoms", "contribution", "key_role", "rows", "uniform")),
    *(f"{kind}/{camera}" for kind in ("frames", "objects") for camera in ("base_0_rgb", "left_wrist_0_rgb")),
    *("actions", "state"),
)
WORDS = {"groups": {"image": "role:image", "bowl": "word:bowl"}, "ratio": "image/bowl"}


def tables(answer: Result, *names: str) -> list[pl.DataFrame]:
    return [answer[name] for name in names]


#: Every table of every command that answers a question, and every number that overlays and exports show.
QUESTIONS: dict[str, Callable[[OpenStores, Path], pl.DataFrame | list[pl.DataFrame]]] = {
    "ratios of spans": lambda run, other: tables(run.analyze(), "steps", "steps_groups", "contributions_steps"),
    "ratios of words": lambda run, other: run.analyze(**WORDS)["steps"],
    "episodes": lambda run, other: run.episodes,
    "heads": lambda run, other: [run.analyze(by=by)["by"] for by in (("layer", "head"), ("denoise",))],
    "sinks": lambda run, other: run.analyze(without_sinks="")["sinks"],
    "words": lambda run, other: tables(run.words(), "words", "words_episodes"),
    "objects": lambda run, other: tables(run.objects(), "objects_episodes", "iou_episodes"),
    "time": lambda run, other: run.analyze(by=("time",))["by"],
    "compare": lambda run, other: run.compare(other, allow_mismatch=["seed"])["differences"],
    "export": lambda run, other: [
        pl.DataFrame(one["rows"].to_series().reset_index()) for one in run.to_xarray(rows=True)
    ],
    "overlay": lambda run, other: run.overlay(replans=0)["overlay_patches"],
}


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> tuple[Path, Path]:
    """Two stores of other seeds, with equal shapes."""
    folder = tmp_path_factory.mktemp("originals")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(site_writer, "replans_per_block", lambda size, numbers, count=None: 8 // gcd(8, numbers))
        return write_store(folder / "a.zarr", spec=SPEC), write_store(folder / "b.zarr", spec=SPEC, seed=3)


@pytest.fixture(scope="module")
def answers(originals) -> dict[str, list[pl.DataFrame]]:
    return {name: answer(name, *originals) for name in QUESTIONS}


@pytest.fixture
def stores(originals, tmp_path) -> tuple[Path, Path]:
    for store in originals:
        shutil.copytree(store, tmp_path / store.name)
    return tmp_path / "a.zarr", tmp_path / "b.zarr"


def answer(name: str, path: Path, other: Path) -> list[pl.DataFrame]:
    found = QUESTIONS[name](va.open(path), other)
    return found if isinstance(found, list) else [found]


def check_answers(stores: tuple[Path, Path], answers: dict[str, list[pl.DataFrame]]) -> list[str]:
    """Every question ends with its right answer, or names an episode; returns the questions that ended so."""
    refused = []
    for name, expected in answers.items():
        try:
            found = answer(name, *stores)
        except CorruptEpisode as error:
            assert re.search(r"task\d{3}_episode\d{3}", str(error)), error  # noqa: PT017
            refused.append(name)
        else:
            drop = [frame.drop("store", strict=False) for frame in found]
            assert all(a.equals(b.drop("store", strict=False)) for a, b in zip(drop, expected, strict=True)), name
    return refused


def all_bytes(store: Path) -> dict[str, bytes]:
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("*") if file.is_file()}


FAST = (
    "files of joint/rows exchanged",
    "chunks of rows: other bits of the same crc32c",
    "an episode copied under another name",
)


@pytest.mark.parametrize("name", thorough_except(FAST, attacks(list(ARRAYS))))
def test_no_question_is_answered_with_bytes_of_something_else(stores, answers, tmp_path, name):
    before = all_bytes(stores[0])
    attacks(list(ARRAYS))[name](*stores)
    check_answers(stores, answers)
    if all_bytes(stores[0]) == before:
        return  # what was exchanged is the same in both, as the numbers of the layers are
    assert verify_store(open_store(stores[0]))
    with pytest.raises(CorruptEpisode, match=r"task\d{3}_episode\d{3}"):
        copy_store(open_store(stores[0]), tmp_path / "copy.zarr", ())


def test_an_edited_root_answers_nothing(stores):
    """Every field of the run's configuration, one at a time."""
    content = (stores[0] / "zarr.json").read_bytes()
    by_name = 0
    leaves = root_leaves(stores[0])
    for place in leaves.values():
        edit_root(stores[0], place)
        with pytest.raises(va.UserError) as caught:  # for some the root itself says it: a gap in a layout, a head twice
            str(va.open(stores[0]).analyze())
        by_name += "task000_episode000 cannot be read: its seal belongs to a run of another" in str(caught.value)
        for question in (
            lambda run: run.analyze(list=True),
            lambda run: run.episodes,
            OpenStores.words,
            OpenStores.overlay,
        ):
            with pytest.raises(va.UserError):
                question(va.open(stores[0]))
        (stores[0] / "zarr.json").write_bytes(content)
    assert by_name > 0.6 * len(leaves)


COMMANDS = {
    "analyze": (["--no-plots"], "joint/atoms"),
    "words": (["--no-plots"], "joint/rows"),
    "objects": (["--no-plots"], "objects/base_0_rgb"),
    "analyze --by layer,head": (["--csv"], "joint/atoms"),
    "analyze --list": (["--no-plots"], "joint/key_role"),
    "overlay": (["--replans", "0"], "joint/key_role"),
    "report": ([], "joint/key_role"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_ends_with_one_sentence_that_names_the_episode(stores, tmp_path, capsys, command):
    words, array = COMMANDS[command]
    flip_bit(first(stores[0]), array)
    output = tmp_path / ("out.html" if command == "report" else "out")
    name, *more = command.split()
    assert main([name, str(stores[0]), *more, *words, "--output", str(output)]) == 2
    said = capsys.readouterr().err.strip()
    assert "task000_episode000" in said
    assert array in said
    assert "\n" not in said
    assert not output.exists()


def test_an_episode_copied_under_another_name_counts_once_when_asked(stores, originals, tmp_path, capsys):
    assert main([str(originals[0]), "--no-plots", "--output", str(tmp_path / "whole")]) == 0
    shutil.copytree(first(stores[0]), stores[0] / "episodes/task000_episode007")
    assert main([str(stores[0]), "--no-plots", "--skip-corrupt", "--output", str(tmp_path / "out")]) == 0
    assert "task000_episode007" in " ".join(capsys.readouterr().out.split())
    tables = [pl.read_parquet(tmp_path / folder / "episodes.parquet") for folder in ("whole", "out")]
    assert tables[0].equals(tables[1])


def test_the_records_of_a_job_may_differ(originals, stores, answers):
    """Another job, on another machine, may have added the episodes; the weights may lie elsewhere."""
    edit_root(stores[0], ("provenance", "numpy"))
    edit_root(stores[0], ("policy", "checkpoint"))
    assert check_answers(stores, {name: answers[name] for name in ("ratios of spans", "episodes", "words")}) == []
    # No number comes from them; that they were changed is found by the digest in the root alone.
    (fault,) = verify_store(open_store(stores[0]))
    assert fault.where == "zarr.json"
    reseal_root(stores[0])
    assert verify_store(open_store(stores[0])) == []


def test_episodes_of_a_store_of_the_same_configuration_can_be_moved_here(tmp_path):
    first_ = write_store(tmp_path / "a.zarr", spec=SPEC, tasks=(0,))
    other = write_store(tmp_path / "b.zarr", spec=SPEC, tasks=(1,))
    edit_root(other, ("provenance", "numpy"))
    for folder in (other / "episodes").glob("task*"):
        folder.rename(first_ / "episodes" / folder.name)
    store = open_store(first_)
    assert verify_store(store) == []
    assert store.task_ids == (0, 1)
