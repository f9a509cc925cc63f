"""A rerun is paired with its base only where both hold the same inputs: one input of one replan is another, and said.

Every store names the same base and has the base's actions and digest; only the named input differs.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tests.kit.reruns import BASE, PLANTED, base_actions, changed_actions, knockout, write_with
from tests.kit.stores import rerun_source, write_store
from vla_attention.analyze.core.reruns import check_same_calls
from vla_attention.schemas.interventions import ImageChange, Interventions, NoiseChange, PromptChange
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import StoreError

SPEC = replace(BASE, tasks=(1,), episodes=1, frames=True, plant_actions=base_actions)
CUT = knockout("without_state", "role:state")
#: The replan that is another one.
WHERE = (1, 0, 3)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("same_calls") / "base.zarr", spec=SPEC)


def spec_of(base, interventions):
    planted = replace(PLANTED["without_state"], interventions=interventions)
    return replace(
        SPEC, plant_actions=changed_actions(planted), interventions=interventions, rerun_of=rerun_source(base)
    )


def at(change):
    """A change of one replan of one episode."""

    def changed(task, episode, replan, record):
        return change(record) if (task, episode, replan) == WHERE else record

    return changed


def another_picture(camera):
    def change(record):
        frame = record.frames[camera].copy()
        frame[0, 0, 0] ^= 1  # one bit of one number
        return replace(record, frames={**record.frames, camera: frame})

    return change


def another_prompt(record):
    return replace(record, prompt=structs.replace(record.prompt, text=record.prompt.text + " "))


def another_state(record):
    return replace(record, state=np.nextafter(record.state, np.inf))


def another_seed(record):
    return replace(record, noise_seed=record.noise_seed ^ 1)


INPUTS = {
    "environment step": (lambda record: replace(record, env_step=record.env_step + 1), "environment step"),
    "noise seed": (another_seed, "noise seed"),
    "prompt": (another_prompt, "prompt"),
    "state": (another_state, "state"),
    "picture": (another_picture("left_wrist_0_rgb"), "'left_wrist_0_rgb'"),
    "two": (lambda record: another_seed(another_state(record)), "noise seed .*state"),
}


def check(base, path):
    """Every episode of a rerun against its base's."""
    first, other = open_store(base), open_store(path)
    for episode, own in zip(first.episodes, other.episodes, strict=True):
        check_same_calls(first, episode, other, own)


def refused(base, path):
    with pytest.raises(StoreError) as caught:
        check(base, path)
    return str(caught.value)


@pytest.mark.parametrize("name", INPUTS)
def test_one_other_input_of_one_replan_is_named(base, tmp_path, name):
    change, named = INPUTS[name]
    path = write_with(tmp_path / "rerun.zarr", spec_of(base, CUT), at(change))
    assert re.search(f"Policy call 3 of task001_episode000 of {path} .*{named} .*{base}", refused(base, path))


@pytest.mark.parametrize(
    ("interventions", "free", "held"),
    [
        (Interventions("noise", noise=NoiseChange(1)), ["noise seed"], ["prompt", "state", "picture"]),
        (
            Interventions("prompt_empty", prompt=PromptChange("empty")),
            ["prompt"],
            ["noise seed", "state", "picture"],
        ),
        (
            Interventions("blank", images=(ImageChange("left_wrist_0_rgb", "blank"),)),
            ["picture"],
            ["noise seed", "state", "prompt"],
        ),
        (
            Interventions("blank", images=(ImageChange("base_0_rgb", "blank"),)),
            [],
            ["noise seed", "state", "prompt", "picture"],
        ),
    ],
    ids=["noise", "prompt", "picture", "another picture"],
)
def test_what_a_condition_changes_may_differ_and_nothing_else(base, tmp_path, interventions, free, held):
    for name in free:
        path = write_with(tmp_path / f"{name}.zarr", spec_of(base, interventions), at(INPUTS[name][0]))
        check(base, path)
    for name in held:
        path = write_with(tmp_path / f"{name}.zarr", spec_of(base, interventions), at(INPUTS[name][0]))
        assert INPUTS[name][1] in refused(base, path)


def test_a_rerun_of_a_run_with_another_prompt_has_that_prompt(tmp_path):
    """The base's own change is in what its calls were given, and a rerun repeats it."""
    own = Interventions("prompt_empty", prompt=PromptChange("empty"))
    base = write_store(tmp_path / "base.zarr", spec=replace(SPEC, interventions=own))
    spec = spec_of(base, own)
    check(base, write_store(tmp_path / "same.zarr", spec=spec))
    path = write_with(tmp_path / "other.zarr", spec, at(another_prompt))
    assert "prompt" in refused(base, path)


@pytest.mark.parametrize("fact", ["instruction", "task_name"])
def test_another_task_of_the_same_number_is_named(base, tmp_path, fact):
    path = write_with(tmp_path / "rerun.zarr", spec_of(base, CUT), lambda *given: given[-1], **{fact: "dance"})
    said = refused(base, path)
    assert "'dance'" in said


def test_actions_that_the_rerun_found_in_its_base_are_those_of_the_base(base, tmp_path):
    spec = spec_of(base, CUT)

    def found(difference):
        def change(task, episode, replan, record):
            actions = base_actions(task, episode, SPEC.replans)[replan]
            return replace(record, base_actions=actions + difference * ((task, episode, replan) == WHERE))

        return change

    check(base, write_with(tmp_path / "a.zarr", spec, found(0.0)))
    path = write_with(tmp_path / "b.zarr", spec, found(1e-9))
    assert re.search(f"Policy call 3 of task001_episode000 .*{base} .*{path}", refused(base, path))
