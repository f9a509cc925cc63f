"""Rollouts of a policy in the suite `cubes` without recording, to measure how often it solves the tasks.

What happens in an episode is as in a capture: the waiting steps, then a policy call for every few actions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from vla_attention.capture.environments.base import Observation, Task
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, NAMED_COLOURS, CubeTask
from vla_attention.capture.environments.episode_protocol import WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.interventions.images import BLACK, blank
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.small_policy.experts import expert_action, read_state
from vla_attention.schemas.errors import BadArgument, listing

#: What is changed for the policy. `blind`: both pictures are black. `wordless`: the instruction is empty. `switched`:
#: from the first policy call after `SWITCH_STEP` steps on the instruction names another cube, and that one counts.
Condition = Literal["normal", "blind", "wordless", "switched"]
CONDITIONS: tuple[Condition, ...] = ("normal", "blind", "wordless", "switched")
SWITCH_STEP = 10


@dataclass(frozen=True)
class Outcome:
    """How one episode went. first_touched: the cube that the gripper touched first; named: the one that was meant."""

    task: int
    state: int
    condition: Condition
    success: bool
    steps: int
    first_touched: str | None
    named: str


@dataclass(frozen=True)
class RolloutSettings:
    """What an episode's outcome depends on, besides the policy, the task and the initial state.

    max_steps: of an episode. replan_steps: actions of each policy call that are executed. seed: of the policy's noise.
    """

    max_steps: int
    replan_steps: int
    seed: int
    condition: Condition = "normal"


def run_episode(
    environment: CubesEnvironment, policy: Policy, task: Task, state: int, settings: RolloutSettings
) -> Outcome:
    """Run one episode from the initial state `state` and return how it went."""
    condition, seed = settings.condition, settings.seed
    observation = _begin(environment, task, state, seed)
    instruction = task.instruction
    step, replan, success, switched = 0, 0, False, False
    while step < settings.max_steps and not success:
        # At the first policy call from that step on: which steps have one depends on the number of actions of a call.
        if condition == "switched" and not switched and step >= SWITCH_STEP:
            other = CUBE_TASKS[other_task(task.task_id)]
            environment.switch_task(other)
            instruction, switched = other.instruction, True
        assert observation is not None
        policy_input = _changed(policy, policy.prepare(observation, instruction), condition)
        actions = policy.act(policy_input, policy.replan_noise_seed(seed, task.task_id, state, replan))
        replan += 1
        chunk = min(settings.replan_steps, settings.max_steps - step)
        for i in range(chunk):
            result = environment.step(actions[i], observe=i == chunk - 1)
            step, success = step + 1, result.success
            observation = result.observation
            if success:
                break
    named = environment.named_cube
    return Outcome(task.task_id, state, condition, success, step, environment.first_touched, named)


def _begin(environment: CubesEnvironment, task: Task, state: int, seed: int) -> Observation | None:
    """Begin an episode and wait; returns what is seen after the last waiting step."""
    environment.give_task(CUBE_TASKS[task.task_id])
    environment.reset(state, seed)
    for _ in range(WAIT_STEPS - 1):
        environment.step(np.array(WAIT_ACTION), observe=False)
    return environment.step(np.array(WAIT_ACTION), observe=True).observation


def _changed(policy: Policy, policy_input: PolicyInput, condition: Condition) -> PolicyInput:
    given = policy_input.given
    if condition == "blind":
        black = {camera: blank(frame, BLACK) for camera, frame in given.frames.items()}
        return policy.prepare_again(replace(given, frames=black, camera_frames={}))
    if condition == "wordless":
        return policy.prepare_again(replace(given, instruction=""))
    return policy_input


def run_expert(environment: CubesEnvironment, task: Task, state: int, settings: RolloutSettings) -> Outcome:
    """Run one episode of the scripted expert, without noise, and return how it went; it decides at every step."""
    _begin(environment, task, state, settings.seed)
    verb, simulator, step, success = CUBE_TASKS[task.task_id].verb, environment.simulator, 0, False
    while step < settings.max_steps and not success:
        action = expert_action(verb, read_state(simulator), simulator.target, simulator.destination)
        success = environment.step(action, observe=False).success
        step += 1
    return Outcome(task.task_id, state, "normal", success, step, environment.first_touched, environment.named_cube)


def other_task(number: int) -> int:
    """Return the task with the same verb whose instruction names the next colour.

    Raises:
        BadArgument: there is none, as the instruction names a place, or the next colour already.
    """
    other = _with_next_colour(CUBE_TASKS[number])
    if other not in CUBE_TASKS:
        known = [number for number, task in enumerate(CUBE_TASKS) if _with_next_colour(task) in CUBE_TASKS]
        raise BadArgument(
            f"No task is like task {number} ({CUBE_TASKS[number].name}) with another colour, which the condition "
            f"'switched' needs; choose by --task-id among {listing(known, 40)}."
        )
    return CUBE_TASKS.index(other)


def _with_next_colour(task: CubeTask) -> CubeTask | None:
    if task.target not in NAMED_COLOURS:
        return None
    following: Any = NAMED_COLOURS[(NAMED_COLOURS.index(task.target) + 1) % len(NAMED_COLOURS)]
    return replace(task, target=following)
