"""What comes from the cache is what is measured, only what is new is measured, and nothing damaged comes from it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.attacks import attacks, files_of, first, two
from tests.kit.stores import StoreSpec, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.cache import remembered
from vla_attention.analyze.cache.kept_files import kept_files
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures import scan
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import settings_from_keywords
from vla_attention.capture.store import site_writer
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=9, contributions=True, prompts="same")
ARRAYS = (
    *(f"joint/{name}" for name in ("atoms", "contribution", "key_role", "rows")),
    *(f"{kind}/{camera}" for kind in ("frames", "objects") for camera in ("base_0_rgb", "left_wrist_0_rgb")),
    *("actions", "state"),
)
#: A grouping of spans, which is answered from atoms, and one of words, which needs the rows.
SPANS: dict[str, object] = {"grouping": "cameras"}
WORDS: dict[str, object] = {"groups": {"image": "role:image", "bowl": "word:bowl"}, "ratio": "image/bowl"}


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> tuple[Path, Path]:
    """Two stores of other seeds, with equal shapes; rows are in three blocks."""
    folder = tmp_path_factory.mktemp("originals")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(site_writer, "replans_per_block", lambda size, numbers, count=None: 8 // gcd(8, numbers))
        return write_store(folder / "a.zarr", spec=SPEC), write_store(folder / "b.zarr", spec=SPEC, seed=3)


@pytest.fixture
def stores(originals, tmp_path) -> tuple[Path, Path]:
    for store in originals:
        shutil.copytree(store, tmp_path / store.name)
    return tmp_path / "a.zarr", tmp_path / "b.zarr"


@pytest.fixture
def measured(monkeypatch) -> list[str]:
    """The names of the episodes that are measured from now on."""
    names: list[str] = []
    one = scan._scanned

    def watched(given: Any, **settings: Any) -> list[Any]:
        names.append(given[0].episode.name)
        return one(given, **settings)

    monkeypatch.setattr(scan, "_scanned", watched)
    return names


def tables(path: Path, **settings: object) -> list[pl.DataFrame]:
    answer = va.open(path).analyze(**settings)  # type: ignore[arg-type]
    return [answer[name] for name in ("tasks", "episodes", "replans", "steps", "steps_groups", "tasks_groups")]


def same(found: list[pl.DataFrame], expected: list[pl.DataFrame]) -> bool:
    """Bit for bit, as `equals` compares floats."""
    return all(a.equals(b) for a, b in zip(found, expected, strict=True))


@pytest.fixture
def uncached(monkeypatch) -> Callable[..., list[pl.DataFrame]]:
    def answer(path: Path, **settings: object) -> list[pl.DataFrame]:
        with monkeypatch.context() as patch:
            patch.setenv("VLA_CACHE", "off")
            return tables(path, **settings)

    return answer


QUESTIONS: tuple[dict[str, object], ...] = (
    SPANS,
    WORDS,
    {"grouping": "cameras", "layers": [2, 0]},
    {"grouping": "cameras", "denoise": "last", "heads": 1},
    {"grouping": "cameras", "per_head": True},
    {"grouping": "cameras", "tasks": 1},
    {"groups": {"bowl": "word:bowl", "rest": "*"}},
    {"groups": {"rest": "*", "bowl": "word:bowl"}},
)


def test_a_second_analysis_measures_nothing_and_gives_the_same_bits(cache, originals, measured, uncached):
    path = originals[0]
    expected = [uncached(path, **question) for question in QUESTIONS]
    measured.clear()
    for question, answer in zip(QUESTIONS, expected, strict=True):
        assert same(tables(path, **question), answer), question  # each one while others are in the cache
    assert len(measured) > 4 * (len(QUESTIONS) - 2)
    measured.clear()
    for question, answer in zip(QUESTIONS, expected, strict=True):
        assert same(tables(path, **question), answer), question
    assert measured == []
    shutil.rmtree(cache)
    assert same(tables(path, **SPANS), expected[0])
    assert len(measured) == 4


def test_one_more_episode_costs_one_episode(cache, stores, measured, uncached, tmp_path):
    aside = two(stores[0])[1].rename(tmp_path / "aside")
    tables(stores[0], **WORDS)
    assert len(measured) == 3
    aside.rename(two(stores[0])[1])
    measured.clear()
    found = tables(stores[0], **WORDS)
    assert measured == ["task000_episode001"]
    assert same(found, uncached(stores[0], **WORDS))


def test_another_arithmetic_measures_anew(cache, originals, measured, monkeypatch):
    tables(originals[0], **SPANS)
    measured.clear()
    monkeypatch.setattr(remembered, "arithmetic_version", lambda: "another")
    tables(originals[0], **SPANS)
    assert len(measured) == 4


def test_masses_without_some_keys_are_kept_apart(cache, originals, measured):
    question = ask([open_store(originals[0])], settings_from_keywords(**WORDS))
    found = {}
    for without in ((), (0, 1), (0, 2), (0, 1)):
        selected = tuple(replace(item, without=without) for item in question.selected)
        masses = [one.valid for one in levels_of(replace(question, selected=selected)).measured]
        if without in found:
            assert all(np.array_equal(*pair) for pair in zip(masses, found[without], strict=True))
        found[without] = masses
    assert len(measured) == 12
    assert not any(np.array_equal(found[()][0], found[other][0]) for other in ((0, 1), (0, 2)))
    assert not np.array_equal(found[0, 1][0], found[0, 2][0])


FAST = (
    "files of joint/atoms exchanged",
    "joint/rows exchanged",
    "an episode copied under another name",
    "the root of another run",
)


@pytest.mark.parametrize("name", thorough_except(FAST, attacks(list(ARRAYS))))
def test_no_attack_is_answered_from_the_cache(cache, stores, uncached, name):
    """A question about a damaged store ends as without the cache: refused, or with the right numbers."""
    for path in stores:
        for question in (SPANS, WORDS):
            tables(path, **question)
    kept = sum(size for _, size, _ in kept_files(cache))
    assert kept > 0
    attacks(list(ARRAYS))[name](*stores)
    for question in (SPANS, WORDS):
        expected, found = (outcome(answer, stores[0], question) for answer in (uncached, tables))
        assert type(found) is type(expected)
        assert same(found, expected) if isinstance(expected, list) else str(found) == str(expected)


def outcome(
    answer: Callable[..., list[pl.DataFrame]], path: Path, question: dict[str, object]
) -> list[pl.DataFrame] | CorruptEpisode:
    """The tables, or the error that the question ends with."""
    try:
        return answer(path, **question)
    except CorruptEpisode as error:
        return error


@pytest.mark.parametrize("array", ["joint/atoms", "joint/rows"])
def test_a_byte_that_changes_in_place_is_noticed_whatever_the_dates_say(cache, stores, array):
    question = WORDS if array == "joint/rows" else SPANS
    tables(stores[0], **question)
    file = files_of(first(stores[0]), array)[0]
    before = file.stat()
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 1
    file.write_bytes(content)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        tables(stores[0], **question)


def test_an_episode_that_was_captured_again_has_its_new_numbers(cache, stores, measured, uncached, tmp_path):
    tables(stores[0], **SPANS)
    episode = first(stores[0])
    write_store(tmp_path / "again.zarr", spec=SPEC, seed=SPEC.seed, plant_success=lambda *_: True)
    shutil.rmtree(episode)
    shutil.copytree(tmp_path / "again.zarr/episodes" / episode.name, episode)
    measured.clear()
    found = tables(stores[0], **SPANS)
    assert measured == [episode.name]
    assert same(found, uncached(stores[0], **SPANS))
    assert found[1].filter(task_id=0, episode_index=0)["success"].to_list()[0] is True


def test_a_cache_that_cannot_be_written_changes_nothing(stores, tmp_path, monkeypatch, uncached):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("VLA_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(remembered, "SETTLED_SECONDS", 0.0)
    assert same(tables(stores[0], **SPANS), uncached(stores[0], **SPANS))


def test_damaged_files_are_measured_again(cache, stores, measured, uncached):
    expected = uncached(stores[0], **SPANS)
    tables(stores[0], **SPANS)
    path = kept_files(cache)[0][2]
    whole = path.read_bytes()
    numbers = whole.index(b"\n") + 1
    for position in (0, numbers, len(whole) // 2, len(whole) - 40, len(whole) - 1):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x10]) + whole[position + 1 :])
        measured.clear()
        assert same(tables(stores[0], **SPANS), expected), position
        assert len(measured) == 1, position
        assert path.read_bytes() == whole


CODE = """
import sys
from vla_attention.analyze.cache import remembered
remembered.SETTLED_SECONDS = 0.0
import vla_attention as va
run = va.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
run.analyze(grouping="cameras")["steps"].write_parquet(sys.argv[2])
"""


@pytest.mark.thorough
def test_processes_that_fill_one_cache_at_the_same_time_agree(cache, stores, measured, tmp_path):
    outputs = [tmp_path / f"{i}.parquet" for i in range(3)]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", CODE, str(stores[0]), str(output)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        for output in outputs
    ]
    for process in running:
        assert process.stdout.readline() == b"ready\n"
    for process in running:
        process.stdin.write(b"\n")
        process.stdin.flush()
    for process in running:
        process.communicate(timeout=120)
        assert process.returncode == 0
    found = [pl.read_parquet(output) for output in outputs]
    assert all(one.equals(found[0]) for one in found)
    assert va.open(stores[0]).analyze(grouping="cameras")["steps"].equals(found[0])
    assert measured == []
