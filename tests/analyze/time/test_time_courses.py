from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.alignment import (
    on_episode_time,
    replan_starts,
)
from vla_attention.analyze.time.time_courses import ALL, FAILURE, SUCCESS, TimeSettings, time_courses
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.testing.stores import StoreSpec, write_store

REPLANS = 9


def closes_at(task, episode):
    """None for one episode: its gripper stays open."""
    return None if (task, episode) == (2, 1) else 2 + (task + episode) % 4


def actions(task, episode, replans):
    planned = np.random.default_rng([task, episode]).normal(size=(replans, 5, 7))
    planned[..., -1] = -0.7
    if closes_at(task, episode) is not None:
        planned[closes_at(task, episode), 2:, -1] = 0.4
        planned[closes_at(task, episode) + 1 :, :, -1] = 0.9
    return planned


def solved(task, episode):
    return (task + episode) % 2 == 0


def log_ratio(task, episode):
    """Planted: a half from the closing on, and 0.8 more in solved episodes; the rest is noise."""
    generator = np.random.default_rng([7, task, episode])
    values = (
        1.0 + 0.3 * task + 0.8 * solved(task, episode) + generator.normal(0, 0.1) + generator.normal(0, 0.05, REPLANS)
    )
    if closes_at(task, episode) is not None:
        values[closes_at(task, episode) :] -= np.log(2.0)
    return values


def plant_rows(task, episode, tokens, rows):
    visual = tokens.key_role == Role.IMAGE
    read = np.isin(tokens.key_role, [int(Role.INSTRUCTION), int(Role.BOS), int(Role.TEMPLATE)])
    read = read & (tokens.key_role != Role.TEMPLATE)
    share = 0.9 / (1 + np.exp(-log_ratio(task, episode)))[:, None]
    weight = share * visual / visual.sum(axis=1, keepdims=True) + (0.9 - share) * read / read.sum(axis=1, keepdims=True)
    weight = weight + 0.1 * (tokens.key_role == Role.ACTION) / 5
    return np.broadcast_to(weight[:, None, None, None, None, :], rows.shape)


SPEC = StoreSpec(
    tasks=(0, 1, 2, 3), episodes=4, replans=REPLANS, layers=(0,), heads=(0,), denoise_steps=(9,), frames=False,
    coverage=False, plant_rows=plant_rows, plant_actions=actions, plant_success=solved, mantissa_bits=23,
)  # fmt: skip
NAMES = SPEC.names


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("time") / "planted.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def question(store):
    return question_about(store)


@pytest.fixture(scope="module")
def courses(question):
    return time_courses(question, TimeSettings(num_bins=5, window=3))


def test_a_bin_is_the_mean_of_the_step_function():
    values = np.array([[1.0], [3.0], [5.0]])
    starts = np.array([0, 5, 10])
    # 12 steps in 4 bins of 3 steps: 0-3, 3-6, 6-9, 9-12.
    expected = [1.0, (2 * 1.0 + 1 * 3.0) / 3, 3.0, (1 * 3.0 + 2 * 5.0) / 3]
    assert on_episode_time(values, starts, 12, 4)[:, 0] == pytest.approx(expected)


@given(st.data())
@settings(deadline=None)
def test_bins_agree_with_a_finely_sampled_step_function(data):
    generator = np.random.default_rng(data.draw(st.integers(0, 1000)))
    starts = np.append(0, np.cumsum(generator.integers(1, 6, data.draw(st.integers(0, 8)))))
    num_steps = int(starts[-1] + generator.integers(1, 6))
    values = generator.normal(size=(len(starts), 2))
    bins = data.draw(st.integers(2, 12))
    # Each policy step in as many pieces as there are bins: then no piece lies in two bins.
    step = np.repeat(np.arange(num_steps), bins)
    fine = values[np.searchsorted(starts, step, side="right") - 1]
    expected = fine.reshape(bins, num_steps, 2).mean(axis=1)
    assert on_episode_time(values, starts, num_steps, bins) == pytest.approx(expected, abs=1e-9)


def expected_logs():
    """Straight from the arrays of the store's recipe: log ratio (replan,) by (task, episode)."""
    return {name: log_ratio(*name) for name in NAMES}


def test_the_course_is_that_of_plain_numpy(courses):
    rows = courses.course.filter(alignment="episode", quantity="ratio")
    logs = expected_logs()
    for outcome, members in (
        (ALL, NAMES),
        (SUCCESS, [name for name in NAMES if solved(*name)]),
        (FAILURE, [name for name in NAMES if not solved(*name)]),
    ):
        found = rows.filter(outcome=outcome).sort("position")
        assert found["num_episodes"].to_list() == [len(members)] * 5
        means = np.zeros(5)
        for name in members:
            # Policy step by policy step, each in five pieces.
            num_steps = 5 * REPLANS - name[1] % 2
            step = np.repeat(np.arange(num_steps), 5)
            means += logs[name][step // 5].reshape(5, num_steps).mean(axis=1) / len(members)
        assert found["value"].to_numpy() == pytest.approx(np.exp(means), rel=1e-5)
        assert (found["low"] < found["value"]).all()
        assert (found["value"] < found["high"]).all()


@pytest.mark.drawn
def test_the_command_writes_tables_and_pictures(store, tmp_path, capsys):
    assert main(["time", str(store), "--output", str(tmp_path / "out"), "--bins", "4", "--window", "2", "--pdf"]) == 0
    assert "SUCCESS AGAINST FAILURE" in capsys.readouterr().out
    table = pl.read_parquet(tmp_path / "out" / "time_course.parquet")
    assert table["alignment"].unique().sort().to_list() == ["episode", "gripper"]
    for stem in ("time_course", "time_course_gripper"):
        for kind in ("png", "pdf", "csv"):
            assert (tmp_path / "out" / f"{stem}.{kind}").stat().st_size > 0


def test_replans_beyond_the_end_of_an_episode_are_refused(store, tmp_path, capsys, monkeypatch):
    from vla_attention.schemas.stores.reader import StoredEpisode

    plain = StoredEpisode.attributes.func  # type: ignore[attr-defined]

    def shortened(self):

        return replace(plain(self), num_steps=3)

    monkeypatch.setattr(StoredEpisode, "attributes", property(shortened))
    assert main(["time", str(store), "--output", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "do not fit into its 3 steps" in error
    assert not json.dumps(error).count("Traceback")


def test_replans_that_do_not_fit_their_episode_are_refused():
    assert replan_starts(np.array([10, 15, 20]), 10, 11, "it").tolist() == [0, 5, 10]
    for steps, wait, length in (([10, 15], 5, 20), ([10, 10], 10, 20), ([10, 15], 10, 5), ([], 10, 5)):
        with pytest.raises(StoreError, match="do not fit"):
            replan_starts(np.array(steps, dtype=np.int64), wait, length, "it")
