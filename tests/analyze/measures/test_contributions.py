"""Norms of contributions against the vectors that the Gram matrices were made of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.analyze.measures.contributions import LINGUISTIC_ROLES, VISUAL_ROLES, contribution_table, joint_norm
from vla_attention.analyze.measures.selected import load_tokens
from vla_attention.analyze.stores.selection import select
from vla_attention.schemas.segments import segments_of
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, contribution_vectors, write_store
from vla_attention.testing.tokens import small_tokens

SPEC = StoreSpec(contributions=True, replans=3, tasks=(0, 1), episodes=2)


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
    selected = load_tokens([(store, episode) for episode in store.episodes], "joint")
    table = contribution_table(selected, select(store.attributes, layers=[2]))
    assert table is not None
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


def test_a_store_without_contributions_has_no_norms(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr"))
    selected = load_tokens([(store, episode) for episode in store.episodes], "joint")
    assert contribution_table(selected, select(store.attributes)) is None
