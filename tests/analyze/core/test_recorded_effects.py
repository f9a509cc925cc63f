"""Calls that were made again without a change have to be the executed ones: where they are not, a note says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.kit.questions import question_about
from tests.kit.stores import SMALL_CONDITIONS, StoreSpec, small_effects, write_store
from vla_attention.analyze.core.recorded_effects import recorded_effects

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=3, coverage=False, frames=False)


@pytest.mark.parametrize("differs", [False, True])
def test_an_unchanged_call_that_differs_is_noted_with_its_place(tmp_path, differs):
    def plant(task, episode, replan, tokens):
        """Under all other conditions actions change by about one spread; unchanged calls at two replans at most."""
        made = small_effects(task, episode, replan, tokens)
        off = {(0, 1, 0): 0.1, (1, 0, 2): 0.2}.get((task, episode, replan), 0.0) if differs else 1e-6
        change = np.concatenate([np.full((1, 5, 7), off, np.float32), made.change[1:]])
        return replace(made, change=change)

    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_effects=plant))
    found = recorded_effects(question_about(path), attention=False)
    assert SMALL_CONDITIONS[0].name not in found.rows().collect()["condition"].to_list()
    assert len(found.notes) == differs
    assert all("policy call 2 of task001_episode000" in note for note in found.notes)
