"""Entropy and effective keys of known rows."""

from __future__ import annotations

import numpy as np

from vla_attention.analyze.heads.entropy import effective_keys, entropies


def test_known_rows_have_known_entropies():
    rows = np.array(
        [[[0.25, 0.25, 0.25, 0.25, 0.0]], [[1.0, 0.0, 0.0, 0.0, 0.0]], [[0.5, 0.5, 0.0, 0.0, 0.0]]], np.float32
    )
    every = np.ones((1, 5, 1), np.float32)
    found = entropies(rows, every)[:, 0, 0]
    np.testing.assert_allclose(found, np.log([4, 1, 2]), atol=1e-6)
    np.testing.assert_allclose(effective_keys(found), [4, 1, 2], rtol=1e-6)
