"""Norms of contributions against the vectors that the Gram matrices were made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, contribution_vectors, expected_arrays, write_store
from tests.kit.tokens import small_tokens
from vla_attention.analyze.core.contributions import LINGUISTIC_ROLES, VISUAL_ROLES, Norms, joint_norm, side_norms
from vla_attention.schemas.segments import segment_members, segments_of
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(contributions=True, replans=3, tasks=(0, 1), episodes=2)


def norms_of(store, **settings) -> Norms:
    norms = side_norms(question_about(store, **settings))
    assert norms is not None
    return norms


@given(seed=st.integers(0, 2**16), parts=st.integers(1, 6), chosen=st.integers(0, 63))
def test_the_norm_of_a_union_is_that_of_the_summed_vectors(seed, parts, chosen):
    vectors = np.random.default_rng(seed).normal(size=(5, parts, 3))
    mask = np.array([chosen >> i & 1 for i in range(parts)], dtype=bool)
    gram = np.einsum("qaw,qbw->ab", vectors, vectors) / len(vectors)
    expected = np.sqrt((vectors[:, mask].sum(axis=1) ** 2).sum(axis=1).mean())
    assert joint_norm(gram, mask) == pytest.approx(expected, abs=1e-9)


def test_both_sides_and_their_ratio_equal_a_direct_computation(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", spec=SPEC))
    assert verify_store(store) == []
    table = norms_of(store, layers=(2,)).cells().collect()
    assert table.height == 4 * SPEC.replans * len(SPEC.denoise_steps)
    for row in table.iter_rows(named=True):
        seed = [SPEC.seed, row["task_id"], row["episode_index"]]
        tokens = small_tokens(SPEC.replans, row["task_id"], seed, changing=True)
        vectors = contribution_vectors(SPEC, tokens, seed, row["replan"])[
            1, SPEC.denoise_steps.index(row["denoise_step"])
        ]
        segments = segments_of(tokens.layout, tokens.key_role[row["replan"]])
        for side, roles in (("visual", VISUAL_ROLES), ("linguistic", LINGUISTIC_ROLES)):
            mask = np.array([segment.role in roles for segment in segments])
            expected = np.sqrt((vectors[:, mask].sum(axis=1) ** 2).sum(axis=1).mean())
            assert row[f"{side}_norm"] == pytest.approx(expected, rel=1e-4)
        assert row["contribution_ratio"] == pytest.approx(row["visual_norm"] / row["linguistic_norm"])
        sums = {}
        rows = expected_arrays(SPEC, row["task_id"], row["episode_index"])["joint/rows"]
        mean = rows[row["replan"], 1, SPEC.denoise_steps.index(row["denoise_step"])].mean(axis=(0, 1))
        members = segment_members(tokens.layout, tokens.key_role, segments)[row["replan"]]
        num_valid = np.broadcast_to(tokens.valid, tokens.key_role.shape)[row["replan"]].sum()
        for side, names in (("above", VISUAL_ROLES), ("below", LINGUISTIC_ROLES)):
            chosen = [i for i, segment in enumerate(segments) if segment.role in names]
            weights = [members[:, i].sum() / num_valid / mean[members[:, i]].sum() for i in chosen]
            summed = sum(weight * vectors[:, i] for weight, i in zip(weights, chosen, strict=True))
            sums[side] = np.sqrt((summed**2).sum(axis=1).mean())
        assert row["uniform_ratio"] == pytest.approx(sums["above"] / sums["below"], rel=1e-3)
        assert row["ratio_lift"] == pytest.approx(row["contribution_ratio"] / row["uniform_ratio"])


def uniform_over_valid(task, episode, tokens, rows):
    even = np.broadcast_to(tokens.valid[:, None, None, None, None], rows.shape)
    return even / even.sum(axis=-1, keepdims=True)


def test_uniform_attention_has_a_lift_of_one_whatever_the_values_are(tmp_path):
    spec = replace(SPEC, plant_rows=uniform_over_valid)
    store = open_store(write_store(tmp_path / "a.zarr", spec=spec))
    table = norms_of(store).cells().collect()
    assert table["contribution_ratio"].std() > 0.1
    np.testing.assert_allclose(table["ratio_lift"], 1.0, rtol=1e-3)


def test_the_baseline_needs_all_heads(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", spec=replace(SPEC, heads=(1,))))
    table = norms_of(store).cells().collect()
    assert table["contribution_ratio"].is_not_null().all()
    assert table["uniform_ratio"].is_null().all()


def test_rows_over_episodes_have_the_three_means_and_what_each_is_of(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", spec=SPEC))
    norms = norms_of(store)
    table = norms.cells().collect()
    rows = norms.ratios(question_about(store).sampling)
    assert rows["layer"].to_list() == ["0", "2", "layers_avg"]
    wanted = (pl.col("layer") == 0, pl.col("layer") == 2, pl.lit(True))
    for layer, row in zip(wanted, rows.iter_rows(named=True), strict=True):
        means = (
            table.filter(layer)
            .group_by("task_id", "episode_index")
            .agg(
                pl.col("visual_norm", "linguistic_norm").mean(),
                pl.col("ratio_lift", "uniform_ratio").log().mean().exp(),
                pl.col("contribution_ratio").mean().alias("mean"),
                pl.col("contribution_ratio").log().mean().alias("log"),
            )
        )
        assert row["ratio_mean"] == pytest.approx(means["mean"].mean())
        assert row["geometric_mean"] == pytest.approx(np.exp(means["log"].mean()))
        assert row["ratio_of_means"] == pytest.approx(means["visual_norm"].mean() / means["linguistic_norm"].mean())
        for name in ("ratio_lift", "uniform_ratio"):
            assert row[name] == pytest.approx(np.exp(means[name].log().mean()))
        for name in ("ratio_mean", "geometric_mean", "ratio_of_means", "ratio_lift"):
            assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]
