"""Entropy, effective keys and top-k mass: random stores and groupings against scipy and sorting, and known rows."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import entropy as entropy_of_scipy

from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW, leaky, raw_episodes, weights_of
from vla_attention.analyze.heads.entropy import effective_keys, entropies, top_mass
from vla_attention.analyze.heads.row_metrics import RowOptions, groups_with_valid_keys, row_metrics
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.testing.stores import StoreSpec, every_key_seen, write_store
from vla_attention.testing.strategies import episode_tokens, groupings


def by_hand(row: np.ndarray, weights: np.ndarray) -> float:
    """Minus the relative entropy of the attention inside a group to its weights; with whole keys, Shannon's entropy."""
    inside = row * weights
    if inside.sum() <= 0:
        return float("nan")
    # scipy takes 0 x ln(0 / 0) for 0, and renormalises both. No weight is 0 where a probability is above 0.
    return float(np.log(weights.sum()) - entropy_of_scipy(inside, weights))


def test_known_rows_have_known_entropies():
    rows = np.array(
        [[[0.25, 0.25, 0.25, 0.25, 0.0]], [[1.0, 0.0, 0.0, 0.0, 0.0]], [[0.5, 0.5, 0.0, 0.0, 0.0]]], np.float32
    )
    every = np.ones((1, 5, 1), np.float32)
    found = entropies(rows, every)[:, 0, 0]
    np.testing.assert_allclose(found, np.log([4, 1, 2]), atol=1e-6)
    np.testing.assert_allclose(effective_keys(found), [4, 1, 2], rtol=1e-6)


def test_a_group_of_fractions_reaches_its_number_of_keys_and_no_more():
    weights = np.array([0.5, 0.25, 0.0, 1.0], np.float32)
    rows = np.array([[[0.1, 0.1, 0.7, 0.1]], [[0.0, 0.3, 0.7, 0.0]]], np.float32)
    found = effective_keys(entropies(rows, weights[None, :, None]))[:, 0, 0]
    # Attention that is even over the covered area: 1.75 keys. All of it on the quarter of a key: a quarter of a key.
    np.testing.assert_allclose(found, [1.75, 0.25], rtol=1e-5)


def test_the_smallest_masses_still_have_an_entropy():
    rows = np.full((1, 1, 6), 1e-12, np.float32)
    rows[0, 0, 0] = 1.0
    weights = np.ones((1, 6, 2), np.float32)
    weights[0, 0, 1] = 0.0
    np.testing.assert_allclose(entropies(rows, weights)[0, 0], [0.0, np.log(5)], atol=1e-4)


def test_top_masses_do_not_depend_on_the_order_of_their_numbers():
    rows = np.random.default_rng(0).dirichlet(np.full(20, 0.2), (2, 3)).astype(np.float32)
    valid = np.ones((1, 20), bool)
    np.testing.assert_array_equal(top_mass(rows, valid, (5, 1)), top_mass(rows, valid, (1, 5))[..., ::-1])


def test_a_group_needs_a_key_that_is_in_it_and_valid_at_the_same_replan():
    item = SimpleNamespace(valid=np.array([[True, False], [False, True]]))
    never = SimpleNamespace(names=("never", "once"), weights=np.zeros((2, 2, 2)))
    never.weights[0, 1, 0] = never.weights[1, 0, 0] = never.weights[1, 1, 1] = 1.0
    assert groups_with_valid_keys([item], [never]) == ("once",)


@FEW
@given(data=st.data())
def test_the_table_of_rows_equals_scipy_and_sorting_on_raw_rows(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    spec = StoreSpec(
        tokens=tokens,
        plant_rows=leaky,
        plant_uniform=every_key_seen,
        tasks=(0,),
        episodes=1,
        queries=data.draw(st.sampled_from(["mean", "all"])),
        layer_labels=(0, 2, 4),
    )
    options = RowOptions(top=(2, 1, 7))
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        question = question_about(path, grouping)
        shown = groups_with_valid_keys(question.selected, resolve_all(grouping, question.selected))
        found = row_metrics(question, options)
        (raw,) = raw_episodes(path, spec)
    table, inside = found.cells, {name: found.of_group(name) for name in shown}
    rows, valid = raw.held()
    weights = weights_of(grouping, tokens) * valid[:, :, None]
    assert table.height == rows[..., 0].size
    assert table["layer"].unique().sort().to_list() == [0, 2, 4]
    assert set(table.filter(layer=4)["block"]) == {0}
    having = {name for i, name in enumerate(grouping.names) if weights[:, :, i].any()}
    assert set(shown) == having
    assert found.groups["group"].to_list() == list(shown) * table.height
    for own in inside.values():
        assert own["row"].to_list() == table["row"].to_list() == list(range(table.height))
    for row, (replan, layer, denoise, head) in zip(
        table.iter_rows(named=True), np.ndindex(rows.shape[:4]), strict=True
    ):
        where = (row["replan"], row["layer"], row["denoise_step"], row["head"])
        assert where == (replan, (0, 2, 4)[layer], spec.denoise_steps[denoise], spec.heads[head])
        seen = rows[replan, layer, denoise, head]
        everything = entropy_of_scipy(seen)
        assert row["entropy"] == pytest.approx(everything, abs=2e-5)
        assert row["effective_keys"] == pytest.approx(np.exp(everything), rel=1e-4)
        largest = np.sort(seen)[::-1] / seen.sum()
        for k in options.top:
            assert row[f"top{k}_mass"] == pytest.approx(largest[:k].sum(), rel=1e-5)
        for name in shown:
            expected = by_hand(seen, weights[replan, :, grouping.names.index(name)])
            own = inside[name].row(row["row"], named=True)
            if np.isnan(expected):
                assert own["entropy"] is None
                assert own["effective_keys"] is None
            else:
                assert own["entropy"] == pytest.approx(expected, abs=5e-5)
                assert own["effective_keys"] == pytest.approx(np.exp(expected), rel=2e-4)


def test_keys_that_are_padding_at_some_replans_are_in_no_entropy_of_a_group_there(tmp_path):
    """A third state digit is there at some replans; at the others its key is padding, and takes mass nonetheless."""
    spec = StoreSpec(
        tasks=(0,), episodes=2, replans=4, plant_rows=leaky, plant_uniform=every_key_seen, mantissa_bits=23
    )
    path = write_store(tmp_path / "a.zarr", spec=spec)
    grouping = Grouping("g", {"text": ("span:prompt",), "rest": ("*",)})
    tables = row_metrics(question_about(path, grouping))
    inside = tables.cells.select("row", "episode_index").join(tables.of_group("text"), on="row", maintain_order="left")
    text = np.zeros(spec.layout.num_keys)
    text[spec.layout.span("prompt").start : spec.layout.span("prompt").stop] = 1.0
    for raw in raw_episodes(path, spec):
        assert (raw.valid != raw.valid[0]).any()
        found = inside.filter(episode_index=raw.order[1])["entropy"].to_numpy()
        cells = np.ndindex(raw.rows.shape[:4])
        expected = [by_hand(raw.rows[cell], text * raw.valid[cell[0]]) for cell in cells]
        np.testing.assert_allclose(found, expected, atol=5e-5)
