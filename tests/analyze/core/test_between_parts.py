"""Solved against failed episodes, and the parts of an episode: planted factors, and means by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from benchmarks.null_stores import names_something
from tests.kit.archives import example_store
from tests.kit.stores import StoreSpec, small_steps, write_store
from tests.kit.tokens import random_rows
from vla_attention.schemas.layout import Role

SPEC = StoreSpec(tasks=(0, 1), episodes=6, replans=6, layers=(0, 1), heads=(0,), denoise_steps=(9,), frames=False)
AVERAGE = pl.col("layer") == "layers_avg"


def rows_of(factor):
    """Pictures get `factor(episode, replan)` times as much; noise of every key."""

    def plant(task, episode, tokens, rows):
        made = random_rows(tokens, rows.shape[1:-1], seed=10 * task + episode, spread=0.1)
        for replan in range(len(made)):
            made[replan][..., tokens.key_role[replan] == Role.IMAGE] *= factor(episode, replan)
        return made / made.sum(axis=-1, keepdims=True)

    return plant


def solved(task, episode):
    """Task 1 has no failed episode."""
    return task == 1 or episode % 2 == 0


def test_solved_and_failed_episodes_are_compared_within_tasks_that_have_both(tmp_path):
    planted = rows_of(lambda episode, replan: 2.0 if episode % 2 == 0 else 1.0)
    run = va.open(write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_success=solved, plant_rows=planted)))
    found = run.analyze(by="outcome")
    assert found.findings[0].numbers["tasks_with_both"] == 1
    table = found["solved_against_failed"]
    row = table.row(by_predicate=pl.col("item") == "visual / linguistic", named=True)
    logs = run.analyze()["episodes"].filter(AVERAGE, task_id=0).sort("episode_index")["geometric_mean"].log().to_numpy()
    assert row["times"] == pytest.approx(np.exp(logs[::2].mean() - logs[1::2].mean()))
    assert (row["num_solved"], row["num_failed"], row["num_tasks"]) == (3, 3, 1)
    assert 1.5 < row["times_low"] < 2 < row["times_high"] < 2.5
    assert row["q"] < 0.01
    assert found.findings[0].numbers["shown"] >= 1


def test_where_no_task_has_both_nothing_is_said():
    found = va.open(example_store("cubes_one_colour")).analyze(by="outcome")
    assert found.findings[0].numbers == {"tasks_with_both": 0}
    assert "solved_against_failed" not in [table.name for table in found.tables]


@pytest.mark.parametrize("steps", [None, small_steps])
def test_parts_of_an_episode_before_and_after_the_touch(tmp_path, steps):
    """The touch is in the middle, where halves meet too; from there on the pictures get twice as much."""
    planted = rows_of(lambda episode, replan: 2.0 if replan >= 3 else 1.0)
    run = va.open(write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_rows=planted, plant_steps=steps)))
    found = run.analyze(by="time")
    table = found["by_parts"].filter(item="visual / linguistic")
    later = ["before the touch", "after the touch"] if steps else ["in the first half", "in the second half"]
    assert table["part"].to_list() == ["at the first call", *later]
    logs = run.analyze()["replans"].filter(AVERAGE).sort("task_id", "episode_index", "replan")["ratio"].log()
    logs = logs.to_numpy().reshape(2, 6, 6)  # (task, episode, replan)
    parts = [logs[..., 0], logs[..., 1:3].mean(axis=-1), logs[..., 3:].mean(axis=-1)]
    np.testing.assert_allclose(table["amount"], [np.exp(part.mean()) for part in parts])
    np.testing.assert_allclose(table["times"][2], np.exp((parts[2] - parts[1]).mean()))
    assert table["times_low"][2] > 1.5
    assert table["q"].to_list()[0] is None
    assert table["q"][1] > 0.05 > table["q"][2]
    # The twenty moments are drawn, and in the files.
    assert found["by"]["phase"].n_unique() == 20
    assert [figure.name for figure in found.figures] == ["by_time", "by_time_groups"]
    assert [table.name for table in found.tables if table.columns] == ["by_parts"]


def test_what_was_not_shown_says_what_would_have_been(tmp_path):
    spec = replace(SPEC, plant_success=lambda task, episode: episode % 2 == 0, plant_rows=rows_of(lambda *_: 1.0))
    found = va.open(write_store(tmp_path / "a.zarr", spec=spec)).analyze(by="outcome").findings[0]
    assert found.numbers == {"tasks_with_both": 2, "shown": 0}
    assert "80%" in found.limit


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["outcome", "time"])
def test_planted_differences_are_named(kind, tmp_path):
    assert names_something(kind, 0, planted=True, folder=tmp_path)
