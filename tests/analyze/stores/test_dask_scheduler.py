"""A dask cluster of real processes gives what this process gives, to the last bit; workers that die are replaced."""

from __future__ import annotations

import os
import signal

import pytest
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.analyze.stores.episode_work import slow_square
from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.stores import parallel
from vla_attention.analyze.stores.parallel import each_episode, workers
from vla_attention.schemas.errors import BadArgument

pytestmark = pytest.mark.thorough

distributed = pytest.importorskip("distributed")

#: The ends of the folders' names in the files.
OWN, OTHERS = b"/a/", b"/b/"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("dask") / "a.zarr", episodes=4, contributions=True)


@pytest.fixture(scope="module")
def cluster():
    import dask

    # One death of a worker is borne, a second one with the same episode is not.
    settings = {"distributed.scheduler.allowed-failures": 1, "distributed.worker.daemon": True}
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="CRITICAL"
        ) as cluster,
    ):
        yield cluster


def test_every_question_has_the_same_answer_to_the_last_bit(cluster, store, monkeypatch):
    def tables():
        run = va.open(store)
        return [
            run.analyze(groups={"bowl": "word:bowl", "rest": "*"})["steps"],
            run.analyze()["tasks_groups"],
            run.analyze()["contributions_steps"],
            run.words()["words"],
            run.objects()["iou"],
        ]

    monkeypatch.setenv("VLA_CACHE", "off")
    here = tables()
    with workers(cluster.scheduler_address):
        there = tables()
    for one, other in zip(here, there, strict=True):
        assert_frame_equal(one, other, check_exact=True)


def test_a_worker_that_is_killed_in_the_middle_is_replaced(cluster):
    killed = []

    def kill_once(_: int) -> None:
        if not killed:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    with workers(cluster.scheduler_address):
        assert list(each_episode(slow_square, range(12), kill_once)) == [i * i for i in range(12)]
    assert killed


def test_the_command_line_takes_an_address(cluster, store, tmp_path, capsys):
    for folder, options in (("a", []), ("b", ["--scheduler", cluster.scheduler_address])):
        assert main([str(store), "--no-plots", "--output", str(tmp_path / folder), *options]) == 0
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == sorted(file.name for file in (tmp_path / "b").iterdir())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes().replace(OWN, OTHERS) == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "no address", "http://127.0.0.1:1"])
def test_an_address_without_a_scheduler_is_named(store, tmp_path, capsys, monkeypatch, address):
    monkeypatch.setattr(parallel, "_ANSWER_WITHIN", 0.2)
    assert main([str(store), "--no-plots", "--output", str(tmp_path), "--scheduler", address]) == 2
    assert f"'{address}'" in capsys.readouterr().err
    with pytest.raises(BadArgument), workers(address):
        pass
