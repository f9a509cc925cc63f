"""What the page says of an episode's steps: what was touched first, whose goal was reached."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from msgspec import structs

from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.http_ranges import serve
from tests.kit.stores import StoreSpec, small_steps, write_store
from vla_attention.capture.store.replan_records import RecordedSteps

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
    standing = structs.replace(other, task_id=9, task_name="nine", instruction="leave it there", first_held=0)
    goals = (own, structs.replace(other, instruction="push the plate\u202e", first_held=3), standing)
    return replace(made, attributes=structs.replace(made.attributes, goals=goals))


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
