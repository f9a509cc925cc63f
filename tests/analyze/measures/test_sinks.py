"""Which keys are sinks, of which task and role, and the measures without them, on raw rows, random and planted."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import entropy as entropy_of_scipy

from tests.kit.made_up_steps import flat
from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW, RawEpisode, leaky, raw_episodes, weights_of
from vla_attention.analyze.heads.head_study import study_heads
from vla_attention.analyze.heads.row_metrics import RowOptions, row_metrics
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.measures.sinks import SinkRule, describe_sinks, key_sums, sinks_table, without_sinks
from vla_attention.analyze.measures.steps import measure_episodes, step_tables
from vla_attention.schemas.layout import Role
from vla_attention.testing.stores import StoreSpec, write_store
from vla_attention.testing.strategies import episode_tokens, groupings
from vla_attention.testing.tokens import small_layout, small_tokens

BOS = small_layout().span("prompt").start


def shares_of(raw: RawEpisode, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Of each key the share of rows in which it takes more than factor x its uniform share, and its mean share."""
    rows, valid = raw.held()
    above, held, count = np.zeros(valid.shape[1]), np.zeros(valid.shape[1]), 0
    for replan, layer, denoise, head in np.ndindex(rows.shape[:4]):
        row = rows[replan, layer, denoise, head]
        above += row / row.sum() > factor / valid[replan].sum()
        held += row / row.sum()
        count += 1
    return above / count, held / count


@FEW
@given(data=st.data())
def test_sinks_are_the_keys_that_a_loop_over_raw_rows_finds(data):
    tokens = data.draw(episode_tokens())
    rule = SinkRule(data.draw(st.sampled_from([1.37, 2.11, 4.03])), data.draw(st.sampled_from([0.2, 0.5])))
    spec = StoreSpec(
        tokens=tokens, plant_rows=leaky, tasks=(0, 1), episodes=1, queries=data.draw(st.sampled_from(["mean", "all"]))
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        # A block that is named twice has its rows counted once: the shares below are over the recorded layers.
        found = sinks_table(question_about(path), rule)
        raws = raw_episodes(path, spec)
    for raw in raws:
        above, held = shares_of(raw, rule.factor)
        of_task = found.filter(task_id=raw.order[0])
        assert sorted(of_task["key"]) == np.flatnonzero(above >= rule.share - 1e-9).tolist()
        assert of_task["mean_mass"].is_sorted(descending=True)
        num_valid = raw.valid.sum(axis=1).mean()
        for row in of_task.iter_rows(named=True):
            key = row["key"]
            assert row["share_of_rows"] == pytest.approx(above[key])
            assert row["mean_mass"] == pytest.approx(held[key], rel=1e-4)
            assert row["times_uniform"] == pytest.approx(held[key] * num_valid, rel=1e-4)
            span = next(span for span in tokens.layout.spans if span.start <= key < span.stop)
            assert row["span"] == span.name
            assert f"key {key} of span '{span.name}'" in row["description"]
            if span.grid is not None:
                assert (row["patch_row"], row["patch_column"]) == divmod(key - span.start, span.grid.columns)
            else:
                assert row["patch_row"] is None


def test_a_block_that_is_named_twice_does_not_count_twice(tmp_path):
    once, twice = StoreSpec(), StoreSpec(layer_labels=(0, 2, 4, 6))
    again = StoreSpec(layer_labels=(0, 2, 6))
    rule = SinkRule(1.5, 0.2)
    tables = [
        sinks_table(question_about(write_store(tmp_path / f"{i}.zarr", spec=spec)), rule)
        for i, spec in enumerate((once, twice, again))
    ]
    assert tables[0].height > 0
    for table in tables[1:]:
        assert table.equals(tables[0])


@pytest.mark.parametrize("keys", [2, 3, 7, 39, 512, 968])
def test_uniform_attention_has_no_sink_even_at_factor_one(keys):
    rows = np.full((2, 3, keys), 1.0 / keys, np.float32)
    above, held = key_sums(rows, np.ones((1, keys), bool), 1.0)
    assert not above.any()
    np.testing.assert_allclose(held, 6.0 / keys, rtol=1e-4)


def test_rows_that_are_all_masked_count_for_nothing():
    rows = np.full((2, 1, 4), 0.25, np.float32)
    valid = np.array([[True, True, False, False], [False] * 4])
    above, held = key_sums(rows, valid, 1.0)
    assert not above.any()
    np.testing.assert_allclose(held, [0.5, 0.5, 0.0, 0.0])


def plant_late_sink(task, episode, tokens, rows):
    """The third state digit takes half of every row of the replans that have one."""
    planted = rows.astype(np.float64).copy()
    planted[..., BOS + 10] = np.where(planted[..., BOS + 10] > 0, 1.0, 0.0)
    return planted / planted.sum(axis=-1, keepdims=True)


def test_a_sink_has_the_role_of_the_replans_at_which_it_is_valid(tmp_path):
    """Whether a late key of a changing prompt is a digit or padding depends on the replan, and on the episode."""
    spec = StoreSpec(tasks=(0,), episodes=6, replans=3, plant_rows=plant_late_sink)
    path = write_store(tmp_path / "a.zarr", spec=spec)
    roles = np.stack([small_tokens(3, 0, [0, 0, i]).key_role[:, BOS + 10] for i in range(6)])
    seen = roles != Role.PADDING
    key = BOS + 10
    assert 0 < seen.sum() < seen.size
    (row,) = [
        row for row in sinks_table(question_about(path), SinkRule(3.0, 0.05)).iter_rows(named=True) if row["key"] == key
    ]
    assert row["share_of_rows"] == pytest.approx(seen.mean(axis=1).mean())
    assert row["role"] == "state"


@FEW
@given(data=st.data())
def test_without_sinks_every_measure_is_that_of_the_other_keys(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    spec = StoreSpec(
        tokens=tokens, plant_rows=leaky, tasks=(0, 1), episodes=1, layer_labels=(0, 2, 4), mantissa_bits=23
    )
    rule = SinkRule(1.9, 0.2)
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        question = question_about(path, grouping)
        sinks = sinks_table(question, rule)
        corrected = without_sinks(question, sinks, rule)
        resolved = resolve_all(corrected.grouping, corrected.selected)
        steps = flat(step_tables(measure_episodes(corrected, resolved), corrected.grouping))
        study = study_heads(corrected, RowOptions(rule=rule))
        raws = raw_episodes(path, spec)
    weights = weights_of(grouping, tokens)
    assert study.rows is not None
    for raw in raws:
        out = sinks.filter(task_id=raw.order[0])["key"].to_list()
        rows, valid = raw.held(out)
        kept = weights.copy()
        kept[:, out] = 0.0
        mass = np.einsum("rldhk,rkg->rldg", raw.rows, kept) / len(spec.heads)
        keys = kept.sum(axis=1)
        part = steps.filter(task_id=raw.order[0])
        even = rows.sum(axis=-1).mean(axis=3) / valid.sum(axis=1)[:, None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            fractions = mass / mass.sum(axis=-1, keepdims=True)
            lifts = mass / keys[:, None, None, :] / even[..., None]
        for i, name in enumerate(grouping.names):
            for column, expected in (("mass", mass), ("fraction", fractions)):
                found = part[f"{name}_{column}"].fill_null(float("nan")).to_numpy().reshape(mass.shape[:3])
                np.testing.assert_allclose(found, expected[..., i], rtol=1e-5, atol=1e-7)
            found = part[f"{name}_lift"].fill_null(float("nan")).to_numpy().reshape(mass.shape[:3])
            has_keys = np.broadcast_to(keys[:, None, None, i] > 1e-6, found.shape)
            np.testing.assert_allclose(found[has_keys], lifts[..., i][has_keys], rtol=1e-4, atol=1e-6)
            np.testing.assert_allclose(
                part[f"{name}_keys"].to_numpy()[:: rows[0, ..., 0, 0].size], keys[:, i], rtol=1e-5
            )
        entropies = entropy_of_scipy(rows, axis=-1)
        found = study.rows.cells.filter(task_id=raw.order[0])["entropy"].to_numpy().reshape(rows.shape[:4])
        np.testing.assert_allclose(found, entropies, atol=1e-4)
    per_task = sinks.group_by("task_id").len().height
    said = describe_sinks(sinks, 2, rule)
    assert said in corrected.notes
    assert ("nothing was taken out" in said) == (per_task == 0)


def test_taking_out_the_sinks_again_takes_out_nothing_twice(tmp_path):
    question = question_about(write_store(tmp_path / "a.zarr"))
    rule = SinkRule(2.0, 0.2)
    sinks = sinks_table(question, rule)
    once = without_sinks(question, sinks, rule)
    again = without_sinks(once, sinks, rule)
    assert [item.without for item in again.selected] == [item.without for item in once.selected]
    assert all(list(item.without) == sorted(set(item.without)) for item in again.selected)
    gone = pl.Series(once.selected[0].without)
    assert not sinks_table(once, rule).filter(task_id=0)["key"].is_in(gone.implode()).any()
    assert row_metrics(once).cells["top1_mass"].max() <= 1.0
