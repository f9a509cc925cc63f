"""Demonstrations in the real simulator: every part has samples, and is the same when it is made again."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("robosuite")

from vla_attention.capture.small_policy.demonstrations import (
    HORIZON,
    DemonstrationSettings,
    Demonstrator,
    NoDemonstration,
)


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


def test_a_part_whose_experts_all_fail_is_a_sentence(monkeypatch) -> None:
    monkeypatch.setattr(Demonstrator, "_episode", lambda self, episode: iter(()))
    demonstrator = Demonstrator.__new__(Demonstrator)
    demonstrator.settings = DemonstrationSettings(seed=3)
    with pytest.raises(NoDemonstration, match=r"Part 2 has no demonstration: .* none of its 20 episodes .* seed 3"):
        demonstrator.part(2)
