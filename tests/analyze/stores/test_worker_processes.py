"""Processes of this machine give what threads give, to the last bit; one that dies is a sentence."""

from __future__ import annotations

import multiprocessing
import os
import re

import pytest
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.analyze.stores.episode_work import damaged, defect, killed_at_two, process_of, square
from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.stores.parallel import WorkersLost, each_episode, workers
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import CorruptEpisode

#: The ends of the folders' names in the files.
OWN, OTHERS = b"/a/", b"/b/"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    spec = StoreSpec(episodes=3, contributions=True, plant_effects=planted_effects())
    return write_store(tmp_path_factory.mktemp("processes") / "a.zarr", spec=spec)


@pytest.fixture(scope="module")
def two():
    with workers(2):
        yield


def test_results_come_in_order_from_other_processes(two):
    counted = []
    assert list(each_episode(square, range(20), counted.append)) == [i * i for i in range(20)]
    assert counted == [1] * 20
    found = set(each_episode(process_of, range(20)))
    assert os.getpid() not in found
    assert len(found) <= 2


def tables(path):
    run = va.open(path)
    of_words, objects = run.analyze(groups={"bowl": "word:bowl", "rest": "*"}), run.objects()
    yield from (of_words[level] for level in ("tasks", "episodes", "steps", "contributions_steps"))
    yield run.analyze(per_head=True, without_sinks="")["steps_groups"]
    yield from (objects[f"{table}_episodes"] for table in ("objects", "pointing", "iou"))
    yield run.effects()["effects"]


def test_every_question_has_the_same_answer_to_the_last_bit(store, monkeypatch):
    monkeypatch.setenv("VLA_CACHE", "off")
    here = list(tables(store))
    with workers(2):
        there = list(tables(store))
    for one, other in zip(here, there, strict=True):
        assert_frame_equal(one, other, check_exact=True)


@pytest.mark.thorough
def test_a_process_that_is_killed_in_the_middle_is_an_error():
    with workers(2), pytest.raises(WorkersLost):
        list(each_episode(killed_at_two, range(6)))


def test_errors_are_raised_as_in_this_process(two):
    results = each_episode(damaged, range(100))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(CorruptEpisode, match=r"^Episode 2 is damaged\.$"):
        next(results)
    with pytest.raises(ZeroDivisionError, match="a defect at 0"):
        list(each_episode(defect, range(3)))
    assert list(each_episode(square, range(3))) == [0, 1, 4]


@pytest.mark.thorough
def test_the_command_line_takes_a_number_of_workers(store, tmp_path, capsys):
    before = set(multiprocessing.active_children())
    for folder, options in (("a", []), ("b", ["--workers", "2"])):
        assert main([str(store), "--no-plots", "--output", str(tmp_path / folder), *options]) == 0
    assert set(multiprocessing.active_children()) <= before
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == sorted(file.name for file in (tmp_path / "b").iterdir())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes().replace(OWN, OTHERS) == (tmp_path / "b" / file).read_bytes(), file


def test_no_workers_are_refused(store, tmp_path, capsys):
    assert main([str(store), "--no-plots", "--output", str(tmp_path), "--workers", "0"]) == 2
    assert re.search("--workers 0; .* 1", capsys.readouterr().err)
    with pytest.raises(BadArgument), workers(0):
        pass
