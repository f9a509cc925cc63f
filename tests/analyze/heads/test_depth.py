"""Parts of an episode's time, and denoise steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.kit.made_up_steps import default_grouping, make_steps, measured_of, replans_of
from vla_attention.analyze.heads.head_study import denoise_tables
from vla_attention.analyze.heads.layer_time import layer_time_table
from vla_attention.analyze.measures.steps import MeasuredEpisode
from vla_attention.analyze.statistics.episode_intervals import Sampling


@pytest.mark.parametrize("num_bins", [1, 4, None])
def test_a_part_of_the_time_weighs_replans_by_their_share_of_it(num_bins):
    """Replans and episodes of unequal lengths, cut into pieces so small that each lies in one replan and one part."""
    grouping = default_grouping()
    steps = make_steps(
        layers=(3, 4), num_replans=5, num_tasks=2, num_episodes=2, no_denominator=0.3, denoise_steps=(0,)
    )
    steps = steps.with_columns(
        env_step=10 + pl.col("replan") * (pl.col("replan") + 3), num_steps=31 + pl.col("episode_index")
    )
    replans = replans_of(steps, grouping)
    table = layer_time_table(replans, grouping, Sampling(), num_bins)
    bins = num_bins or 5
    assert table.height == 2 * bins
    starts = np.array([replan * (replan + 3) for replan in range(5)])
    for row in table.iter_rows(named=True):
        means: list[list[float]] = [[], []]
        for task, episode in np.ndindex(2, 2):
            part = replans.cells.filter(task_id=task, episode_index=episode, layer=row["layer"]).sort("replan")
            values = np.log2(part["ratio"].to_numpy() / part["uniform_ratio"].to_numpy())
            num_steps = 31 + episode
            pieces = np.arange(num_steps * bins)
            inside = pieces[pieces // num_steps == row["bin"]]
            values = values[np.searchsorted(starts, inside // bins, side="right") - 1]
            means[task] += [values[np.isfinite(values)].mean()] if np.isfinite(values).any() else []
        assert row["quantity"] == "log2_lift"
        of_tasks = [np.mean(of_task) for of_task in means if of_task]
        assert row["num_episodes"] == sum(map(len, means))
        assert row["mean"] == (pytest.approx(np.mean(of_tasks)) if of_tasks else None)
        assert (row["start"], row["stop"]) == pytest.approx((row["bin"] / bins, (row["bin"] + 1) / bins))


def with_denoise_order(measured: MeasuredEpisode, order: Sequence[int]) -> MeasuredEpisode:
    """The same masses with the denoise steps in another order, as a user may name them."""
    selection, positions = measured.selection, list(order)
    named = replace(
        selection,
        denoise=tuple(selection.denoise[i] for i in positions),
        denoise_steps=tuple(selection.denoise_steps[i] for i in positions),
    )
    mass, valid_mass, row_sum = (
        values[:, :, positions] for values in (measured.mass, measured.valid_mass, measured.row_sum)
    )
    return replace(measured, selection=named, mass=mass, valid_mass=valid_mass, row_sum=row_sum)


def test_a_denoise_step_is_the_mean_over_layers_of_its_own_ratios():
    grouping = default_grouping()
    steps = make_steps(denoise_steps=(4, 0, 9), layers=(1, 2))
    measured = [with_denoise_order(episode, (1, 0, 2)) for episode in measured_of(steps, grouping)]
    assert measured[0].selection.denoise_steps == (4, 0, 9)
    tables = denoise_tables(measured, grouping, Sampling())
    table = tables.cells
    assert table["denoise_step"].to_list() == [0, 4, 9]
    for row in table.iter_rows(named=True):
        part = steps.filter(denoise_step=row["denoise_step"])
        of_layers = part.group_by("task_id", "episode_index", "replan").agg(pl.col("ratio").mean())
        of_episodes = of_layers.group_by("task_id", "episode_index").agg(pl.col("ratio").mean())
        assert row["ratio_mean"] == pytest.approx(of_episodes["ratio"].mean())
        assert row["denoise_time"] == pytest.approx(1 - row["denoise_step"] / 10)
        assert row["ratio_mean_low"] < row["ratio_mean"] < row["ratio_mean_high"]
        for name in ("visual", "state"):
            own = tables.of_group(name).filter(denoise_step=row["denoise_step"])
            # Masses of a row add up to 1, so that fractions may be averaged in any order.
            assert own["fraction"].to_list() == [pytest.approx(part[f"{name}_fraction"].mean())]
            assert own["denoise_time"].to_list() == [row["denoise_time"]]
