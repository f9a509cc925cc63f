"""Whether a policy turned to what it was told about, in a scene whose own sentence names other things, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vla_attention.analyze.core.behaviour import row_of
from vla_attention.schemas.episode_steps import HAND, EpisodeSteps, TaskGoal

TOLD, OWN = "put the bowl on the plate", "put the cup on the plate"


@pytest.mark.parametrize(
    ("touched", "reached", "scene_names", "followed"),
    [
        ("bowl", None, ("cup", "plate"), True),
        ("cup", None, ("cup", "plate"), False),
        ("table", None, ("cup", "plate"), False),
        (None, None, ("cup", "plate"), False),
        # The plate is named by both sentences.
        ("plate", None, ("cup", "plate"), None),
        ("plate", 0, ("cup", "plate"), True),
        ("cup", 1, ("cup", "plate"), False),
        ("bowl", 0, ("plate", "bowl"), None),
    ],
)
def test_it_follows_where_it_touches_what_the_told_sentence_alone_names(touched, reached, scene_names, followed):
    bodies = (HAND, "bowl", "cup", "plate", "table")
    goals = tuple(
        TaskGoal(task, f"task_{task}", sentence, (f"goal_{task}",), 20 if reached == task else None, things)
        for task, sentence, things in ((0, TOLD, ("bowl", "plate")), (1, OWN, scene_names))
    )
    steps = EpisodeSteps(bodies, tuple(7 if body == touched else None for body in bodies), goals)
    attributes: Any = SimpleNamespace(
        task_id=0, episode_index=0, instruction=TOLD, task_family="", initial_state_digest="s", success=reached == 0,
        scene_task_id=1, num_steps=30,
        objects=tuple(SimpleNamespace(name=body, of_interest=body in ("bowl", "plate")) for body in bodies[1:]),
    )  # fmt: skip
    row = row_of("made_up", attributes, TOLD, steps)
    assert row["followed"] is followed
    assert row["as_told"] is (reached == 0)
    assert row["did"] == {None: None, 0: TOLD, 1: OWN}[reached]
    assert (row["scene_instruction"], row["scene_goal"], row["told_goal"]) == (OWN, "goal_1", "goal_0")
