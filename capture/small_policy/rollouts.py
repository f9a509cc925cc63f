"""Rollouts of a policy in the suite `cubes` without recording, to measure how often it solves the tasks.

What happens in an episode is as in a capture: the waiting steps, then a policy call for every few actions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from vla_attention.capture.environments.base import Observation, Task
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, NAMED_COLOURS
from vla_attention.capture.environments.episode_protocol import WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.small_policy.experts import expert_action, read_state

#: What is changed for the policy. `blind`: both pictures are black. `wordless`: the instruction is empty. `switched`:
#: after `SWITCH_STEP` steps the instruction names another cube, and that one counts.
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


def run_episode(
    environment: CubesEnvironment,
    policy: Policy,
    task: Task,
    state: int,
    condition: Condition,
    *,
    max_steps: int,
    replan_steps: int,
    seed: int,
) -> Outcome:
    """Run one episode and return how it went."""
    observation = _begin(environment, task, state, seed)
    instruction, number = task.instruction, task.task_id
    step, replan, success = 0, 0, False
    while step < max_steps and not success:
        if condition == "switched" and step == SWITCH_STEP:
            number = other_task(number)
            environment.switch_task(CUBE_TASKS[number])
            instruction = CUBE_TASKS[number].instruction
        assert observation is not None
        policy_input = _changed(policy, policy.prepare(observation, instruction), condition)
        actions = policy.act(policy_input, policy.replan_noise_seed(seed, task.task_id, state, replan))
        replan += 1
        chunk = min(replan_steps, max_steps - step)
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
        black = {camera: np.zeros_like(frame) for camera, frame in given.frames.items()}
        return policy.prepare_again(replace(given, frames=black, camera_frames={}))
    if condition == "wordless":
        return policy.prepare_again(replace(given, instruction=""))
    return policy_input


def run_expert(environment: CubesEnvironment, task: Task, state: int, *, max_steps: int, seed: int) -> Outcome:
    """Run one episode of the scripted expert, without noise, and return how it went."""
    _begin(environment, task, state, seed)
    verb, simulator, step, success = CUBE_TASKS[task.task_id].verb, environment.simulator, 0, False
    while step < max_steps and not success:
        action = expert_action(verb, read_state(simulator), simulator.target, simulator.destination)
        success = environment.step(action, observe=False).success
        step += 1
    return Outcome(task.task_id, state, "normal", success, step, environment.first_touched, environment.named_cube)


def other_task(number: int) -> int:
    """Return the task with the same verb whose instruction names the next colour."""
    task = CUBE_TASKS[number]
    other: Any = NAMED_COLOURS[(NAMED_COLOURS.index(task.target) + 1) % len(NAMED_COLOURS)]
    return CUBE_TASKS.index(replace(task, target=other))
