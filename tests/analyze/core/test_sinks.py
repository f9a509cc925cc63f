"""Which keys are sinks, of which task and role, and the measures without them, on raw rows, random and planted."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.archives import example_store
from tests.kit.made_up_steps import steps_of
from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW, RawEpisode, leaky, raw_episodes, weights_of
from tests.kit.stores import StoreSpec, every_key_seen, write_store
from tests.kit.strategies import episode_tokens, groupings
from tests.kit.tokens import small_layout
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.sinks import (
    SinkRule,
    describe_sinks,
    key_sums,
    search_sinks,
    without_sinks,
)
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import Role

BOS = small_layout().span("prompt").start


def shares_of(raw: RawEpisode, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """(layer, head, key): share of rows in which a key takes more than factor x its uniform share, and mean share."""
    rows, valid = raw.held()
    above, held = np.zeros((2, *rows.shape[1:2], *rows.shape[3:]))
    for replan, layer, denoise, head in np.ndindex(rows.shape[:4]):
        row = rows[replan, layer, denoise, head]
        above[layer, head] += row / row.sum() > factor / valid[replan].sum()
        held[layer, head] += row / row.sum()
    count = rows.shape[0] * rows.shape[2]
    return above / count, held / count


@FEW
@given(data=st.data())
def test_sinks_are_the_keys_that_a_loop_over_raw_rows_finds(data):
    tokens = data.draw(episode_tokens())
    rule = SinkRule(
        data.draw(st.sampled_from([1.37, 2.11, 4.03])),
        data.draw(st.sampled_from([0.2, 0.5])),
        data.draw(st.sampled_from([0.1, 0.3])),
        data.draw(st.sampled_from([0.25, 0.6])),
    )
    spec = StoreSpec(
        tokens=tokens,
        plant_rows=leaky,
        plant_uniform=every_key_seen,
        tasks=(0, 1),
        episodes=1,
        queries=data.draw(st.sampled_from(["mean", "all"])),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        # A block that is named twice has its rows counted once: the shares below are over the recorded layers.
        search = search_sinks(question_about(path), rule)
        found = search.sinks
        raws = raw_episodes(path, spec)
    for raw in raws:
        above, held = shares_of(raw, rule.factor)
        of_task = found.filter(task_id=raw.order[0])
        uniform = (1 / raw.valid.sum(axis=1)).mean()
        others = ~(tokens.static_roles == int(Role.ACTION)).any(axis=0)  # the policy's own actions are no sinks
        by_mass = (held > max(rule.mass, 2 * uniform)) & others
        sinks = by_mass | ((above >= rule.share - 1e-9) & others)
        assert sorted(of_task["key"]) == np.flatnonzero(sinks.any(axis=(0, 1))).tolist()
        assert of_task["mean_mass"].is_sorted(descending=True)
        of_heads = search.heads.filter(task_id=raw.order[0])
        places = {(spec.layers[i], spec.heads[j], k) for i, j, k in np.argwhere(sinks)}
        assert set(of_heads.select("block", "head", "key").rows()) == places
        for row in of_task.iter_rows(named=True):
            key = row["key"]
            assert row["share_of_rows"] == pytest.approx(above[..., key].mean(), rel=1e-5)
            assert row["mean_mass"] == pytest.approx(held[..., key].mean(), rel=1e-4)
            assert row["times_uniform"] == pytest.approx(held[..., key].mean() / uniform, rel=1e-4)
            assert row["largest_mass"] == pytest.approx(held[..., key].max(), rel=1e-4)
            assert row["sink_heads"] == sinks[..., key].sum()
            assert row["heads_by_mass"] == by_mass[..., key].sum()
            assert row["widespread"] == (sinks[..., key].mean() >= rule.heads - 1e-9)
            span = next(span for span in tokens.layout.spans if span.start <= key < span.stop)
            assert row["span"] == span.name
            assert f"key {key} of span '{span.name}'" in row["description"]
            if span.grid is not None:
                assert (row["patch_row"], row["patch_column"]) == divmod(key - span.start, span.grid.columns)
            else:
                assert row["patch_row"] is None


def test_keys_of_the_policys_own_actions_are_no_sinks():
    """In the example store the action queries read each other: six of their keys take five times their share."""
    question = question_about(example_store("cubes"))
    search = search_sinks(question)
    actions = search.keys.filter(role="action")
    assert (actions["times_uniform"] > 4).any()
    assert actions.select("sink_heads", "heads_by_mass").sum().row(0) == (0, 0)
    assert not actions["widespread"].any()
    assert set(search.sinks["role"]) == {"instruction", "image", "template", "state"}
    assert not set(search.heads["key"]) & set(actions["key"])
    # So they stay where everything is computed without sinks.
    without = without_sinks(question, search.sinks, SinkRule())
    assert not {key for item in without.selected for key in item.without} & set(actions["key"])


def test_a_block_that_is_named_twice_does_not_count_twice(tmp_path):
    once, twice = StoreSpec(), StoreSpec(layer_labels=(0, 2, 4, 6))
    again = StoreSpec(layer_labels=(0, 2, 6))
    rule = SinkRule(1.5, 0.2)
    tables = [
        search_sinks(question_about(write_store(tmp_path / f"{i}.zarr", spec=spec)), rule).sinks
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
    np.testing.assert_allclose(held, 2.0 / keys, rtol=1e-4)


def out_by_task(sinks: pl.DataFrame) -> list[set[int]]:
    """The keys of each task that `without_sinks` takes out."""
    return [set(part["key"]) for _, part in sinks.filter("widespread").group_by("task_id")]


@FEW
@given(data=st.data())
def test_without_sinks_every_measure_is_that_of_the_other_keys(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    spec = StoreSpec(
        tokens=tokens,
        plant_rows=leaky,
        plant_uniform=every_key_seen,
        tasks=(0, 1),
        episodes=1,
        layer_labels=(0, 2, 4),
        mantissa_bits=23,
    )
    rule = SinkRule(1.9, 0.2)
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        question = question_about(path, grouping)
        sinks = search_sinks(question, rule).sinks
        if any(keys == set(np.flatnonzero(tokens.valid.any(axis=0))) for keys in out_by_task(sinks)):
            with pytest.raises(BadArgument, match="task"):
                without_sinks(question, sinks, rule)
            return
        corrected = without_sinks(question, sinks, rule)
        steps = steps_of(levels_of(corrected)).flat
        raws = raw_episodes(path, spec)
    weights = weights_of(grouping, tokens)
    for raw in raws:
        out = sinks.filter("widespread", task_id=raw.order[0])["key"].to_list()
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
    said = describe_sinks(sinks, 2, rule, float(max(raw.valid.sum(axis=1).mean() for raw in raws)))
    assert said in corrected.notes


def test_taking_out_the_sinks_again_takes_out_nothing_twice(tmp_path):
    question = question_about(write_store(tmp_path / "a.zarr"))
    rule = SinkRule(2.0, 0.2)
    sinks = search_sinks(question, rule).sinks
    once = without_sinks(question, sinks, rule)
    again = without_sinks(once, sinks, rule)
    assert [item.without for item in again.selected] == [item.without for item in once.selected]
    assert all(list(item.without) == sorted(set(item.without)) for item in again.selected)
    gone = pl.Series(once.selected[0].without)
    assert not search_sinks(once, rule).sinks.filter(task_id=0)["key"].is_in(gone.implode()).any()


def sink_of_some_heads(task, episode, tokens, rows):
    """Bos takes 60 % of the rows of 6 of 16 layer-heads, and of the others as much as a key has by chance."""
    noise = np.exp(np.random.default_rng([task, episode]).normal(0, 0.3, rows.shape))
    planted = noise * tokens.valid[:, None, None, None, None]
    for layer, head in [(0, 1), (0, 2), (1, 0), (2, 3), (3, 1), (3, 2)]:
        part = planted[:, layer, :, head]
        part *= 0.4 / (part.sum(axis=-1, keepdims=True) - part[..., [BOS]])
        part[..., BOS] = 0.6
    return planted / planted.sum(axis=-1, keepdims=True)


def test_a_sink_of_some_heads_is_found_and_taken_out_where_it_is_widespread(tmp_path):
    spec = StoreSpec(layers=(0, 1, 2, 3), heads=(0, 1, 2, 3), plant_rows=sink_of_some_heads)
    path = write_store(tmp_path / "a.zarr", spec=spec)
    question = question_about(path)
    search = search_sinks(question)
    assert search.sinks["key"].unique().to_list() == [BOS]
    row = search.sinks.row(0, named=True)
    assert (row["sink_heads"], row["heads_by_mass"], row["num_heads"]) == (6, 6, 16)
    assert row["share_of_rows"] < 0.5, "over all rows it is no sink"
    of_task = search.heads.filter(task_id=0).select("block", "head").rows()
    assert of_task == [(0, 1), (0, 2), (1, 0), (2, 3), (3, 1), (3, 2)]
    assert all(BOS in item.without for item in without_sinks(question, search.sinks, SinkRule()).selected)
    strict = SinkRule(heads=0.5)
    kept = without_sinks(question, search_sinks(question, strict).sinks, strict)
    assert not any(item.without for item in kept.selected)
    assert " 2 tokens" in kept.notes[-1]
