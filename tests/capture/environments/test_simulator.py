"""A drawing context that is kept from one reset to the next: when it is, and that its pictures are the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite")

import mujoco

from vla_attention.capture.environments import simulator
from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.environments.episode_protocol import CAMERAS
from vla_attention.capture.environments.simulator import draw_alike
from vla_attention.capture.environments.suites import find_suite, make_environment

ACTION = np.array([0.3, -0.2, 0.1, 0.0, 0.1, 0.0, 1.0])
SCENE = """<mujoco><worldbody><body name="a" pos="{place} 0 0"><geom type="box" size="{size} 1 1"/></body>
<site name="s" rgba="1 0 0 {opacity}"/></worldbody><visual><map zfar="{far}"/></visual></mujoco>"""


def model(place: float = 0.0, size: float = 1.0, opacity: float = 1.0, far: float = 50.0) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SCENE.format(place=place, size=size, opacity=opacity, far=far))


def test_a_context_serves_a_model_with_bodies_elsewhere_and_no_other() -> None:
    moved, hidden = model(), model()
    moved.body_pos[1], hidden.site_rgba[0, 3] = (0.01, 0, 0), 0
    assert draw_alike(model(), model())
    assert draw_alike(model(), moved)
    assert draw_alike(hidden, model())
    without_area = model(), model()
    for one in without_area:
        one.geom_rgba[:] = np.nan  # as the normals of some of LIBERO's meshes
    assert draw_alike(*without_area)
    assert not draw_alike(model(), model(size=1.1))
    assert not draw_alike(model(), model(far=40))
    # The size of the whole scene is in a context: how far shadows and fog reach.
    assert not draw_alike(model(), model(place=9))


def pictures(environment: Any, index: int) -> list[Any]:
    """Begin an episode; return its pictures, segmentations and the digest of its initial state."""
    environment.reset(index, 7)
    environment.step(ACTION, observe=False)
    observation = environment.step(ACTION, observe=True).observation
    seen = [environment.segmentation(camera) for camera in CAMERAS]
    return [*(observation.images[camera] for camera in CAMERAS), *seen, environment.initial_state_digest]


def context_of(environment: Any) -> Any:
    return environment._simulator.sim._render_context_offscreen


def hold_that_the_context_is_kept(suite: str, task: int, settings: EnvironmentSettings) -> None:
    alone, other = (make_environment(find_suite(suite), task, settings) for _ in range(2))
    try:
        expected, contexts = [], [context_of(alone)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(simulator, "draw_alike", lambda one, other: False)
            for index in (0, 2):  # each in a new context, made by robosuite
                expected.append(pictures(alone, index))
                assert context_of(alone) not in contexts
                contexts.append(context_of(alone))
        first = pictures(other, 0)
        drawing = context_of(other)
        second = pictures(other, 2)
        assert context_of(other) is drawing
        for got, wanted in zip([*first, *second], [*expected[0], *expected[1]], strict=True):
            np.testing.assert_array_equal(got, wanted)
        assert any((one != two).any() for one, two in zip(first[:2], second[:2], strict=True))
        # Another scene's context is not taken over.
        other._simulator.sim.model._model.geom_size[0] *= 1.5
        third = pictures(other, 2)
        assert context_of(other) is not drawing
        for got, wanted in zip(third, expected[1], strict=True):
            np.testing.assert_array_equal(got, wanted)
    finally:
        alone.close()
        other.close()
    assert other._kept_context._kept is None


@pytest.mark.thorough
@pytest.mark.simulator
def test_pictures_in_a_kept_context_are_those_of_a_new_one() -> None:
    hold_that_the_context_is_kept("robosuite", 2, EnvironmentSettings())


@pytest.mark.simulator
@pytest.mark.libero
@pytest.mark.thorough
@pytest.mark.parametrize(("suite", "task"), [("libero_goal", 0), ("libero_90", 20)])
def test_pictures_of_libero_in_a_kept_context_are_those_of_a_new_one(libero_assets, suite, task) -> None:
    hold_that_the_context_is_kept(suite, task, EnvironmentSettings(libero_assets=libero_assets))
