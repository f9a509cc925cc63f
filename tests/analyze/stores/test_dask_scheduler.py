"""A dask cluster of real processes gives what this process gives, to the last bit; workers that die are replaced."""

from __future__ import annotations

import os
import signal
import sys
from functools import partial

import pytest
from polars.testing import assert_frame_equal

import vla_attention as va
from tests.kit.episode_work import damaged, die_always, die_once, process_of, square
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.steps import measure_episodes
from vla_attention.analyze.stores import dask_scheduler
from vla_attention.analyze.stores.dask_scheduler import SchedulerLost
from vla_attention.analyze.stores.parallel import Threads, each_episode, episodes_with, map_episodes, workers
from vla_attention.schemas.errors import BadArgument, MissingDependency
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.testing.stores import write_store

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


@pytest.fixture
def on_cluster(cluster):
    with workers(cluster.scheduler_address):
        yield


def test_results_come_in_order_from_other_processes(on_cluster):
    counted = []
    assert map_episodes(square, range(40), counted.append) == [i * i for i in range(40)]
    assert counted == [1] * 40
    assert os.getpid() not in map_episodes(process_of, range(20))


def test_every_question_has_the_same_answer_to_the_last_bit(on_cluster, store):
    def tables():
        run = va.open(store)
        return [
            run.ratios("steps", groups={"bowl": "word:bowl", "rest": "*"}),
            run.masses("tasks"),
            run.contributions(),
            run.words(),
            run.row_metrics(),
            run.objects("iou"),
        ]

    there = tables()
    with episodes_with(Threads()):
        here = tables()
    for one, other in zip(here, there, strict=True):
        assert_frame_equal(one, other, check_exact=True)


def test_a_worker_that_is_killed_in_the_middle_is_replaced(cluster, on_cluster, store):
    question = question_about(store)
    with episodes_with(Threads()):
        here = measure_episodes(question)
    killed = []

    def kill_once(_: int) -> None:
        if not killed:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    there = measure_episodes(question, progress=kill_once)
    assert killed
    for one, other in zip(here, there, strict=True):
        assert other.item is one.item
        assert one.mass.tobytes() == other.mass.tobytes()


def test_an_episode_with_which_a_worker_dies_is_begun_again(on_cluster, tmp_path):
    assert map_episodes(partial(die_once, marker=tmp_path / "died"), range(8)) == list(range(8))
    assert (tmp_path / "died").exists()


def test_an_episode_with_which_workers_always_die_ends_with_a_sentence(cluster, on_cluster):
    # Named is 3, or an episode that the same worker had begun both times.
    with pytest.raises(SchedulerLost, match=r"died 2 times with \d, the last one was tcp://.*: the system"):
        map_episodes(die_always, range(8))
    assert map_episodes(square, range(3)) == [0, 1, 4]


def test_errors_are_raised_as_in_this_process(on_cluster):
    results = each_episode(damaged, range(100))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(CorruptEpisode, match=r"^Episode 2 is damaged\.$"):
        next(results)


def test_a_scheduler_that_goes_away_ends_with_a_sentence():
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs="CRITICAL"
        ) as cluster,
        workers(cluster.scheduler_address),
    ):
        results = each_episode(square, range(1000))
        assert next(results) == 0
        cluster.close()
        with pytest.raises(SchedulerLost, match=r"The connection to the scheduler tcp://.* was lost while \d+ was"):
            list(results)


def test_the_command_line_takes_an_address(cluster, store, tmp_path, capsys):
    for folder, options in (("a", []), ("b", ["--scheduler", cluster.scheduler_address])):
        assert main([str(store), "--no-plots", "--output", str(tmp_path / folder), *options]) == 0
    files = sorted(file.name for file in (tmp_path / "a").iterdir())
    assert files == sorted(file.name for file in (tmp_path / "b").iterdir())
    for file in files:
        assert (tmp_path / "a" / file).read_bytes().replace(OWN, OTHERS) == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "no address", "http://127.0.0.1:1"])
def test_an_address_without_a_scheduler_is_a_sentence(store, tmp_path, capsys, monkeypatch, address):
    monkeypatch.setattr(dask_scheduler, "_ANSWER_WITHIN", 0.2)
    assert main([str(store), "--no-plots", "--output", str(tmp_path), "--scheduler", address]) == 2
    assert f"No scheduler answers at '{address}'" in capsys.readouterr().err
    with pytest.raises(BadArgument), workers(address):
        pass


@pytest.mark.parametrize("address", ["", "node", "no address", "http://127.0.0.1:1"])
def test_no_client_is_made_with_what_is_no_address(monkeypatch, address):
    def no_client(*_: object, **__: object) -> None:
        raise AssertionError("it waits half a minute at its end, and then prints a traceback")

    monkeypatch.setattr(distributed, "Client", no_client)
    with pytest.raises(BadArgument, match=f"No scheduler answers at '{address}'"), workers(address):
        pass


def test_without_dask_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(MissingDependency, match=r"pip install 'vla-attention\[dask\]', on the workers too"),
        workers("tcp://a:1"),
    ):
        pass
