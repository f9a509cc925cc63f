"""Depth, layers over time, denoise steps: planted centres, centres of contributions, parts of an episode's time."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, measured_of, replans_of
from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW, raw_episodes, weights_of
from vla_attention.analyze.heads.depth import depth_table
from vla_attention.analyze.heads.head_study import denoise_tables, study_heads
from vla_attention.analyze.heads.layer_time import MOST_BINS, layer_time_table
from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.measures.steps import MeasuredEpisode
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.segments import segments_of
from vla_attention.testing.stores import StoreSpec, contribution_vectors, write_store
from vla_attention.testing.strategies import episode_tokens, groupings
from vla_attention.testing.tokens import small_tokens


def plant_depth(task, episode, tokens, rows):
    """Image keys hold 0.1, 0.2, 0.5 of layers 0, 3 and 4, the actions the rest."""
    planted = np.zeros(rows.shape)
    for layer, share in enumerate((0.1, 0.2, 0.5)):
        planted[:, layer, ..., :16] = share / 16
        planted[:, layer, ..., -5:] = (1 - share) / 5
    return planted


def test_the_centre_of_planted_masses_is_where_they_were_planted(tmp_path):
    spec = StoreSpec(layers=(0, 3, 4), num_layers=6, plant_rows=plant_depth, mantissa_bits=23)
    depth = study_heads(question_about(write_store(tmp_path / "a.zarr", spec=spec))).depth
    row = depth.filter(group="visual").row(0, named=True)
    assert row["centre"] == pytest.approx((0.1 * 0 + 0.2 * 3 + 0.5 * 4) / 0.8, rel=1e-6)
    assert row["centre_low"] is None  # the same in every episode: no spread, no interval
    assert row["even"] == pytest.approx(7 / 3)
    assert (row["first_block"], row["last_block"], row["num_layers"]) == (0, 4, 3)
    assert (row["num_episodes"], row["centre_episodes"], row["num_tasks"]) == (4, 4, 2)
    assert depth.filter(group="action")["centre"][0] == pytest.approx((0.8 * 3 + 0.5 * 4) / (0.9 + 0.8 + 0.5), rel=1e-6)
    # A group without mass has no centre and no row.
    assert set(depth["group"]) == {"visual", "action"}


@FEW
@given(data=st.data())
def test_centres_are_those_of_raw_masses_and_a_block_named_twice_weighs_once(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    spec = StoreSpec(tokens=tokens, tasks=(0,), episodes=2, layers=(1, 2, 3), mantissa_bits=23)
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec, layer_labels=(1, 2, 3, 5))
        depth = study_heads(question_about(path, grouping)).depth
        raws = raw_episodes(path, spec)
    weights = weights_of(grouping, tokens)
    for i, name in enumerate(grouping.names):
        centres = []
        for raw in raws:
            amount = np.einsum("rldhk,rk->l", raw.rows, weights[:, :, i])
            centres += [np.average([1, 2, 3], weights=amount)] if amount.sum() > 0 else []
        row = depth.filter(group=name)
        assert row.height == bool(centres)
        if centres:
            assert row["centre"][0] == pytest.approx(np.mean(centres), abs=1e-4)
            assert row["even"][0] == 2.0


def test_centres_of_contributions_are_those_of_the_vectors(tmp_path):
    spec = StoreSpec(contributions=True, layers=(0, 2, 3))
    depth = study_heads(question_about(write_store(tmp_path / "a.zarr", spec=spec))).depth
    found = depth.filter(of="contribution", group="visual").row(0, named=True)
    centres = []
    for task, episode in spec.names:
        seed = [spec.seed, task, episode]
        tokens = small_tokens(spec.replans, task, seed)
        norms = []
        for replan in range(spec.replans):
            chosen = [segment.role == "image" for segment in segments_of(tokens.layout, tokens.key_role[replan])]
            summed = contribution_vectors(spec, tokens, seed, replan)[:, :, :, chosen].sum(axis=3)
            norms.append(np.sqrt((summed**2).sum(axis=-1).mean(axis=2)))
        centres.append(np.average([0, 2, 3], weights=np.mean(norms, axis=(0, 2))))
    assert found["centre"] == pytest.approx(np.mean(centres), rel=1e-5)
    assert found["num_layers"] == 3
    assert 0 <= found["centre_low"] < found["centre"] < found["centre_high"] <= 3


def test_the_centre_of_one_layer_is_its_number(tmp_path):
    spec = StoreSpec(layers=(2,), contributions=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        depth = study_heads(question_about(write_store(tmp_path / "a.zarr", spec=spec))).depth
    for column in ("centre", "even"):
        np.testing.assert_allclose(depth[column].to_numpy(), 2.0)


def test_all_mass_in_the_last_layer_has_its_centre_there(tmp_path):
    def plant(task, episode, tokens, rows):
        planted = plant_depth(task, episode, tokens, rows)
        planted[:, 0, ..., :16] = planted[:, 1, ..., :16] = 0.0
        return planted / planted.sum(axis=-1, keepdims=True)

    spec = StoreSpec(layers=(0, 1, 2), plant_rows=plant)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        depth = study_heads(question_about(write_store(tmp_path / "a.zarr", spec=spec))).depth
    row = depth.filter(group="visual").row(0, named=True)
    assert (row["centre"], row["centre_low"], row["centre_high"]) == (2.0, None, None)


def test_no_mass_at_all_gives_an_empty_table():
    cells = pl.DataFrame(
        {"suite": ["s"] * 2, "task_id": [0] * 2, "episode_index": [0] * 2, "layer": ["0", "1"], "block": [0, 1]}
    )
    groups = cells.with_columns(pl.lit("a").alias("group"), pl.lit(0.0).alias("mass"))
    assert depth_table(Tables(cells, groups), None, Sampling()).is_empty()


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


def test_time_has_no_more_parts_than_replans_and_groups_are_shown_without_a_ratio():
    grouping = custom_grouping(with_ratio=False)
    steps = make_steps(grouping, CUSTOM_KEYS, num_replans=3)
    short = layer_time_table(replans_of(steps, grouping), grouping, Sampling())
    assert short["bin"].n_unique() == 3
    assert short["quantity"].unique(maintain_order=True).to_list() == [
        "base_fraction",
        "wrist_fraction",
        "nouns_fraction",
    ]
    long = make_steps(grouping, CUSTOM_KEYS, num_replans=40)
    assert layer_time_table(replans_of(long, grouping), grouping, Sampling())["bin"].n_unique() == MOST_BINS


def test_all_ratios_infinite_leave_every_part_of_the_time_empty():
    grouping = default_grouping()
    table = layer_time_table(replans_of(make_steps(no_denominator=1.0), grouping), grouping, Sampling())
    assert table["mean"].is_null().all()
    assert (table["num_episodes"] == 0).all()


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
