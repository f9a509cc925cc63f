from __future__ import annotations

import numpy as np
import pytest

from vla_attention.analyze.deviation.deviation_study import root_mean_square, scaled_deviation


def test_steps_that_only_one_side_has_are_not_compared():
    actions = np.arange(2 * 4 * 2, dtype=float).reshape(2, 4, 2)
    of_data = np.zeros((2, 3, 2))
    found = scaled_deviation(actions, of_data, np.array([3, 1]), np.array([2.0, np.nan]))
    assert found.shape == (2, 3, 2)
    assert found[0, :, 0].tolist() == [0.0, 1.0, 2.0]
    assert np.isnan(found[1, 1:]).all()
    assert np.isnan(found[..., 1]).all()
    assert root_mean_square(found, axis=(1, 2)) == pytest.approx([np.sqrt(5 / 3), 4.0])
    assert np.isnan(root_mean_square(found[1, 1:], axis=-1)).all()
