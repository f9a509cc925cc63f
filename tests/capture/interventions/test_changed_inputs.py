"""What a policy call is given, with changed pictures and prompt: places, seeds, and what stays."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs, rotated, shifted
from vla_attention.capture.policies.policy import GivenInputs
from vla_attention.schemas.errors import BadArgument, UnknownName
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import ImageChange, Interventions, PromptChange
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

GRID = PatchGrid(2, 2, 8, 8)
SITES = (
    SiteLayout(
        "joint",
        (
            Span("base", "image", 0, 4, camera="base", grid=GRID),
            Span("wrist", "image", 4, 8, camera="wrist", grid=GRID),
        ),
    ),
)
OBJECTS = (SceneObject("cube", "object", True), SceneObject("table", "background", False))
COVERAGE = {"base": np.array([[0.01, 0.99], [0, 1], [0, 1], [1, 0]], dtype=np.float32)}


@pytest.fixture
def given():
    generator = np.random.default_rng(0)
    frames = {camera: generator.integers(0, 256, (8, 8, 3), dtype=np.uint8) for camera in ("base", "wrist")}
    return GivenInputs(frames, dict(frames), np.zeros(8), "lift the cube")


def context(replan: int = 0, task_id: int = 1) -> CallContext:
    return CallContext(task_id, 2, replan, {1: "lift the cube", 5: "push the ball"}, OBJECTS, COVERAGE)


def image(camera: str, kind: str, **fields: object) -> Interventions:
    return Interventions(images=(ImageChange(camera, kind, **fields),))


def test_only_the_named_camera_changes_and_loses_its_own_picture(given):
    """The camera's own picture goes before the model's; a changed camera has none any more."""
    changed = changed_inputs(given, image("base", "blank"), SITES, context())
    assert (changed.frames["base"] == 128).all()
    assert changed.frames["wrist"] is given.frames["wrist"]
    assert list(changed.camera_frames) == ["wrist"]
    assert changed.instruction == given.instruction
    assert (given.frames["base"] != 128).any()
    assert len(given.camera_frames) == 2


def test_changes_of_one_camera_follow_each_other(given):
    both = Interventions(images=(ImageChange("base", "rotated"), ImageChange("base", "shifted", rows=1)))
    expected = shifted(rotated(given.frames["base"]), GRID, 1, 0)
    np.testing.assert_array_equal(changed_inputs(given, both, SITES, context()).frames["base"], expected)


def test_noise_is_another_one_at_every_replan_camera_and_task(given):
    def noise(camera: str, **place: int) -> np.ndarray:
        return changed_inputs(given, image(camera, "noise", seed=3), SITES, context(**place)).frames[camera]

    first = noise("base")
    np.testing.assert_array_equal(first, noise("base"))
    for other in (noise("wrist"), noise("base", replan=1), noise("base", task_id=2)):
        assert (other != first).mean() > 0.9


@pytest.mark.parametrize("kind", ["masked", "filled"])
def test_an_objects_patches_are_those_that_show_some_of_it(given, kind):
    changed = changed_inputs(given, image("base", kind, object="cube"), SITES, context()).frames["base"]
    same = (changed == given.frames["base"]).all(axis=2)
    assert same[:4, 4:].all()
    assert same[4:, :4].all()
    assert not same[:4, :4].all()
    assert not same[4:, 4:].all()


def test_names_that_do_not_exist(given):
    with pytest.raises(UnknownName, match="'bass'"):
        changed_inputs(given, image("bass", "blank"), SITES, context())
    with pytest.raises(UnknownName, match="'cub'"):
        changed_inputs(given, image("base", "masked", object="cub"), SITES, context())
    with pytest.raises(BadArgument, match=r"'cube' .*'wrist'"):
        changed_inputs(given, image("wrist", "filled", object="cube"), SITES, context())


def test_the_prompt_changes_alone(given):
    changed = changed_inputs(given, Interventions(prompt=PromptChange("task", task_id=5)), SITES, context())
    assert changed.instruction == "push the ball"
    assert changed.frames == given.frames
    assert changed.camera_frames == given.camera_frames
