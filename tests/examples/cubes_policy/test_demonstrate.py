"""Demonstrations in the real simulator: every part has samples, and is the same when it is made again."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("robosuite")

from examples.cubes_policy.demonstrate import (
    HORIZON,
    DemonstrationSettings,
    Demonstrator,
    join_episodes,
)


@pytest.mark.thorough
@pytest.mark.simulator
def test_a_part_depends_on_its_number_alone() -> None:
    settings = DemonstrationSettings(episodes_per_part=1)
    demonstrator = Demonstrator(settings)
    episodes = list(demonstrator.episodes(0))
    list(demonstrator.episodes(1))
    first, again = (join_episodes(0, made, settings) for made in (episodes, list(demonstrator.episodes(0))))
    demonstrator.close()
    assert [len(samples) for samples in episodes] == [len(first["task"])] != [0]
    assert first["actions"].shape[1:] == (HORIZON, 7)
    assert np.abs(first["actions"]).max() <= 1.0
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
