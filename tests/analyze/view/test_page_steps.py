"""What the page says of an episode's steps: what was touched first, whose goal was reached. Wrong ones: a sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.http_ranges import serve
from vla_attention.capture.store.replan_records import RecordedSteps
from vla_attention.testing.stores import StoreSpec, small_steps, write_store

pytestmark = needs_node
EPISODE = "task000_episode001"


def answers_of(stores: list[Path]) -> list[Any]:
    folder = stores[0].parent
    with serve(folder) as served:
        return page_answers(folder, [PageQuestion(f"{served.url}/", f"{one.name}/", episode=EPISODE) for one in stores])


def reaching_the_other(spec: StoreSpec, task: int, episode: int, steps: int) -> RecordedSteps:
    """The goal of the other task is reached at step 3, and a third one held before the first step."""
    made = small_steps(spec, task, episode, steps)
    own, other = sorted(made.attributes.goals, key=lambda goal: goal.task_id != task)
    standing = replace(other, task_id=9, task_name="nine", instruction="leave it there", first_held=0)
    goals = (own, replace(other, instruction="push the plate\u202e", first_held=3), standing)
    return replace(made, attributes=replace(made.attributes, goals=goals))


def test_what_happened_first_is_said(tmp_path):
    stores = [
        write_store(tmp_path / "a.zarr", tasks=(0, 1), plant_steps=small_steps),
        write_store(tmp_path / "b.zarr", tasks=(0, 1), plant_steps=reaching_the_other),
        write_store(tmp_path / "c.zarr"),
    ]
    plain, other, none = [answer["happened"] for answer in answers_of(stores)]
    assert plain == ["touched akita_black_bowl_1 first (step 7)"]
    assert other == [*plain, 'did "push the plate\u202e" (step 3)']
    assert none == []


Changed = Callable[[dict[str, Any]], Any]
WRONG: dict[str, tuple[Changed, str]] = {
    "a touch too few": (lambda s: s["first_touch"].pop(), "first touches of"),
    "a moment beyond": (lambda s: s["first_touch"].__setitem__(1, 15), "steps.first_touch[1] is 15"),
    "no whole moment": (lambda s: s["first_touch"].__setitem__(1, 0.5), "steps.first_touch[1] is 0.5"),
    "a path": (lambda s: s["bodies"].__setitem__(1, "../a"), "steps.bodies[1] is"),
    "no goals": (lambda s: s.pop("goals"), "steps.goals is nothing"),
    "too many goals": (lambda s: s.update(goals=s["goals"] * 6000), "steps.goals is a list of 12000"),
    "a goal of nobody": (lambda s: s["goals"][0].pop("task_id"), "steps.goals[0].task_id is nothing"),
}


def test_wrong_steps_are_a_sentence(tmp_path):
    stores = []
    for number, (change, _) in enumerate(WRONG.values()):
        stores.append(write_store(tmp_path / f"{number}.zarr", tasks=(0, 1), plant_steps=small_steps))
        file = stores[-1] / f"episodes/{EPISODE}/zarr.json"
        document = json.loads(file.read_text())
        change(document["attributes"]["steps"])
        file.write_text(json.dumps(document))
    for (name, (_, sentence)), answer in zip(WRONG.items(), answers_of(stores), strict=True):
        assert sentence in answer["failure"], name
        assert answer["told"], name
