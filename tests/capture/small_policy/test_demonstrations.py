"""Demonstrations in the real simulator: every part has samples, and is the same when it is made again."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("robosuite")

from vla_attention.capture.small_policy.demonstrations import HORIZON, DemonstrationSettings, Demonstrator


@pytest.mark.simulator
def test_a_part_depends_on_its_number_alone() -> None:
    demonstrator = Demonstrator(DemonstrationSettings(episodes_per_part=1))
    given: list[int] = []
    first = demonstrator.part(0, after_episode=given.append)
    demonstrator.part(1)
    again = demonstrator.part(0)
    demonstrator.close()
    assert given == [len(first["task"])] != [0]
    assert first["actions"].shape[1:] == (HORIZON, 7)
    assert np.abs(first["actions"]).max() <= 1.0
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
