"""Scripted experts for the suite `cubes`: controllers without memory, from the simulation state to one clean action.

An expert sees where the cubes are and what the task asks for, not the pictures. Without memory it has an answer at
every state, also at those to which noise or a detour has led, so every visited state can be labelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.cubes.scene import HALF_SIZE
from vla_attention.capture.environments.cubes.tasks import Verb

#: Way of the gripper for an action of 1, in metres (robosuite's OSC_POSE controller).
METRES_PER_ACTION = 0.05
#: Share of the remaining way that one action asks for.
GAIN = 0.9
OPEN, CLOSED = -1.0, 1.0

#: Height of the gripper over a cube's centre while it moves sideways, in metres: fingers pass over all other cubes.
TRAVEL_HEIGHT = 0.11
#: Sideways distance in metres within which the gripper is over its goal.
ALIGNED = 0.012
#: Way between the fingers with a cube between them, in metres. A turned cube is up to 53 mm wide, and an open gripper
#: 79 mm.
HOLDING_GAP = (0.036, 0.064)
#: Speed of the fingers, in metres per second, below which they have stopped.
STOPPED = 0.02
#: Distance in metres from a cube's centre at which a closed gripper is beside it: between the cube and its nearest
#: neighbour there is room for the fingers.
BESIDE = 0.052

#: Axes of the gripper (columns) that points straight down: its fingers close along the world's y.
_STRAIGHT = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class TableState:
    """What an expert sees, in metres and the world frame.

    gripper: (3,) the point between the fingertips. gap: way between the fingers. gap_speed: metres per second, negative
    while they close. upright: (3,) rotation vector that would turn the hand back to its straight pose. cubes:
    (cube, 3) centres.
    """

    gripper: NDArray[np.float64]
    gap: float
    gap_speed: float
    upright: NDArray[np.float64]
    cubes: NDArray[np.float64]


def read_state(simulator: Any) -> TableState:
    """Read the state of a `CubeTable`."""
    robot, data = simulator.robots[0], simulator.sim.data
    fingers = data.qpos[robot._ref_gripper_joint_pos_indexes]
    speeds = data.qvel[robot._ref_gripper_joint_vel_indexes]
    rotation = np.array(data.site_xmat[robot.eef_site_id]).reshape(3, 3)
    # Half of the sum of the axes' cross products is the rotation vector, for small angles.
    upright = 0.5 * np.cross(rotation.T, _STRAIGHT.T).sum(axis=0)
    return TableState(
        gripper=np.array(data.site_xpos[robot.eef_site_id]),
        gap=float(fingers[0] - fingers[1]),
        gap_speed=float(speeds[0] - speeds[1]),
        upright=upright,
        cubes=simulator.cube_positions(),
    )


def expert_action(verb: Verb, state: TableState, target: int, destination: int | None) -> NDArray[np.float64]:
    """Return the clean action (7,) in [-1, 1]: six pose deltas and the gripper."""
    cube = state.cubes[target]
    if verb == "touch":
        goal, gripper = _descend(state.gripper, cube, cube[2] - 0.01), CLOSED
    elif verb in ("push_left", "push_right"):
        goal, gripper = _push(state.gripper, cube, 1.0 if verb == "push_left" else -1.0), CLOSED
    elif verb == "lift":
        goal, gripper = _lift(state, cube)
    else:
        assert destination is not None
        goal, gripper = _put(state, cube, state.cubes[destination])
    return move_to(state, goal, gripper)


def move_to(state: TableState, goal: NDArray[np.float64], gripper: float) -> NDArray[np.float64]:
    """Return the action (7,) towards a goal (3,), with the hand kept straight."""
    action = np.zeros(7)
    action[:3] = np.clip(GAIN * (goal - state.gripper) / METRES_PER_ACTION, -1.0, 1.0)
    action[3:6] = np.clip(state.upright / 0.5, -0.3, 0.3)
    action[6] = gripper
    return action


def _descend(gripper: NDArray[np.float64], over: NDArray[np.float64], height: float) -> NDArray[np.float64]:
    """Return a goal (3,): high above the point until the gripper is over it, and then down to the height."""
    away = float(np.linalg.norm(gripper[:2] - over[:2]))
    # Between aligned and four times as far away, the way down is open in part, so that no jerk marks the border.
    share = np.clip((away - ALIGNED) / (3 * ALIGNED), 0.0, 1.0)
    return np.array([over[0], over[1], height + share * (over[2] + TRAVEL_HEIGHT - height)])


def _holds(state: TableState, cube: NDArray[np.float64]) -> bool:
    near = np.linalg.norm(state.gripper[:2] - cube[:2]) < 0.025 and abs(state.gripper[2] - cube[2]) < 0.03
    return bool(near and HOLDING_GAP[0] < state.gap < HOLDING_GAP[1] and abs(state.gap_speed) < STOPPED)


def _up(way: float) -> NDArray[np.float64]:
    return np.array([0.0, 0.0, way])


def _lift(state: TableState, cube: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    if _holds(state, cube):
        return state.gripper + _up(0.1), CLOSED
    away = np.linalg.norm(state.gripper[:2] - cube[:2])
    around = away < 1.5 * ALIGNED and abs(state.gripper[2] - cube[2]) < 0.015
    if around:
        return np.array([cube[0], cube[1], cube[2]]), CLOSED
    if state.gap < 0.074 and away < 0.04 and state.gripper[2] < cube[2] + 0.05:
        # Half closed and beside the cube: open over it first.
        return np.array([state.gripper[0], state.gripper[1], cube[2] + TRAVEL_HEIGHT]), OPEN
    return _descend(state.gripper, cube, cube[2]), OPEN


def _push(gripper: NDArray[np.float64], cube: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    start = cube - np.array([0.0, side * BESIDE, 0.0])
    low = gripper[2] < cube[2] + 0.025
    behind = side * (cube[1] - gripper[1])
    if low and abs(gripper[0] - cube[0]) < 0.018 and 0.02 < behind < BESIDE + 0.02:
        return np.array([cube[0], gripper[1] + side * 0.05, cube[2]])
    if low and np.linalg.norm(gripper[:2] - start[:2]) > 0.03:
        return np.array([gripper[0], gripper[1], cube[2] + TRAVEL_HEIGHT])
    return _descend(gripper, start, float(cube[2]))


def _put(state: TableState, cube: NDArray[np.float64], base: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    on_top = base[2] + 2 * HALF_SIZE
    sideways = float(np.linalg.norm(cube[:2] - base[:2]))
    grip_offset = state.gripper - cube
    if sideways < 0.02 and abs(cube[2] - on_top) < 0.005:
        return state.gripper + _up(0.05 if state.gap > HOLDING_GAP[1] else 0.0), OPEN
    if _holds(state, cube):
        over = np.array([base[0] + grip_offset[0], base[1] + grip_offset[1], 0.0])
        clear = on_top + 0.035
        if sideways < ALIGNED:
            over[2] = on_top + grip_offset[2] - 0.02  # the controller stops short of its goal
        elif cube[2] < clear - 0.015:
            over[:2] = state.gripper[:2]
            over[2] = clear + grip_offset[2] + 0.02
        else:
            over[2] = clear + grip_offset[2]
        return over, CLOSED
    return _lift(state, cube)
