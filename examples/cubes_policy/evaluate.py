"""`evaluate`: how often a policy solves the tasks of the suite `cubes`, in several processes, without recording.

The simulator's part of an episode is the engine's (`Simulation`): as in a capture, the waiting steps, then the actions
of one policy call after the other.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from examples.cubes_policy.engine import begin_episode, cubes_protocol, share_among_processes
from examples.cubes_policy.experts import expert_action, read_state
from vla_attention.capture.engine.simulation import Advanced
from vla_attention.capture.environments.base import (
    EnvironmentSettings,
    Suite,
    Task,
    check_initial_state_index,
    check_task_id,
)
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, NAMED_COLOURS, CubeTask
from vla_attention.capture.environments.suites import SUITES, find_suite, list_tasks
from vla_attention.capture.foreign_files.checked_files import read_object
from vla_attention.capture.interventions.changed_inputs import BLACK, blank
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.stores.store_format import Protocol
from vla_attention.schemas.stores.store_place import refuse_in_store

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


def run_episode(
    environment: CubesEnvironment,
    policy: Policy,
    task: Task,
    state: int,
    protocol: Protocol,
    condition: Condition = "normal",
) -> Outcome:
    """Run one episode from the initial state `state` and return how it went."""
    simulation, result = begin_episode(environment, CUBE_TASKS[task.task_id], state, protocol)
    instruction = task.instruction
    step, replan, switched = 0, 0, False
    while step < protocol.max_steps and not result.success:
        # At the first policy call from that step on: which steps have one depends on the number of actions of a call.
        if condition == "switched" and not switched and step >= SWITCH_STEP:
            other = CUBE_TASKS[other_task(task.task_id)]
            environment.switch_task(other)
            instruction, switched = other.instruction, True
        assert result.seen is not None
        policy_input = _changed(policy, policy.prepare(result.seen.observation, instruction), condition)
        actions = policy.act(policy_input, policy.replan_noise_seed(protocol.seed, task.task_id, state, replan))
        result = simulation.advance(actions[: min(protocol.replan_steps, protocol.max_steps - step)], observe=True)
        step, replan = step + result.steps, replan + 1
    return _outcome(environment, task, state, condition, step, result)


def _outcome(
    environment: CubesEnvironment, task: Task, state: int, condition: Condition, steps: int, last: Advanced
) -> Outcome:
    touched, named = environment.first_touched, environment.named_cube
    return Outcome(task.task_id, state, condition, last.success, steps, touched, named)


def _changed(policy: Policy, policy_input: PolicyInput, condition: Condition) -> PolicyInput:
    given = policy_input.given
    if condition == "blind":
        black = {camera: blank(frame, BLACK) for camera, frame in given.frames.items()}
        return policy.prepare_again(replace(given, frames=black, camera_frames={}))
    if condition == "wordless":
        return policy.prepare_again(replace(given, instruction=""))
    return policy_input


def run_expert(environment: CubesEnvironment, task: Task, state: int, protocol: Protocol) -> Outcome:
    """Run one episode of the scripted expert, without noise, and return how it went; it decides at every step."""
    simulation, result = begin_episode(environment, CUBE_TASKS[task.task_id], state, protocol)
    verb, table, step = CUBE_TASKS[task.task_id].verb, environment.simulator, 0
    while step < protocol.max_steps and not result.success:
        action = expert_action(verb, read_state(table), table.target, table.destination)
        result = simulation.advance(action[None], observe=False)
        step += 1
    return _outcome(environment, task, state, "normal", step, result)


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


Job = tuple[int, int]
#: Stands for a checkpoint: the scripted experts.
EXPERT = "expert"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `evaluate`."""
    parser.add_argument("checkpoint", help="pi05_cubes, a folder written by export, or `expert`: the scripted one")
    parser.add_argument("--suite", default="cubes", help="cubes (default), or the suite of a control")
    parser.add_argument("--task-id", type=int, nargs="+", metavar="N", help="tasks (default: all)")
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="initial states per task (default: 50)")
    parser.add_argument("--condition", default="normal", help=f"one of {', '.join(CONDITIONS)} (default: normal)")
    parser.add_argument("--replan-steps", type=int, metavar="N", help="actions per policy call (default: the policy's)")
    parser.add_argument("--max-steps", type=int, metavar="N", help="steps of an episode (default: the suite's)")
    parser.add_argument("--seed", type=int, default=7, metavar="N", help="seed of the policy's noise (default: 7)")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="JSON file of every episode; the same command goes on with it"
    )


@dataclass(frozen=True)
class Evaluation:
    """What a file of outcomes is about, besides the condition, which every outcome names.

    replan_steps: actions of each policy call that are executed; None: the policy's own number.
    """

    checkpoint: str
    suite: str
    max_steps: int
    replan_steps: int | None
    seed: int


def run(arguments: argparse.Namespace) -> int:
    """Run the missing episodes, print the rates; returns the exit code."""
    if arguments.output is not None:
        refuse_in_store(arguments.output, "write episodes to")
    suite = find_suite(arguments.suite)
    evaluation, jobs = _planned(arguments, suite)
    condition: Condition = arguments.condition
    outcomes = _read(arguments.output, evaluation)
    known = {(outcome.task, outcome.state, outcome.condition) for outcome in outcomes}
    missing = [(task, state) for task, state in jobs if (task, state, condition) not in known]
    # All tasks of one number of cubes share a simulator, so neighbours in this order need no other one.
    missing.sort(key=lambda job: (CUBE_TASKS[job[0]].num_cubes, job[1], job[0]))

    def keep(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if arguments.output is not None and len(outcomes) % 20 == 0:
            _write(arguments.output, evaluation, outcomes)

    if evaluation.checkpoint != EXPERT and missing:
        _check_policy(evaluation)  # once, before every process would fail at it
    with tqdm(total=len(missing), unit="episode", disable=None) as bar:
        begin = partial(_evaluating, evaluation, condition)
        complete = share_among_processes(begin, missing, arguments.workers, keep, bar)
    if arguments.output is not None:
        _write(arguments.output, evaluation, outcomes)
    tasks = {task for task, _ in jobs}
    print(describe([outcome for outcome in outcomes if outcome.task in tasks and outcome.condition == condition]))
    return 0 if complete else 1


def _planned(arguments: argparse.Namespace, suite: Suite) -> tuple[Evaluation, list[Job]]:
    """Return what is evaluated and its tasks with initial states; raise `BadArgument` for options that cannot be."""
    if suite.kind != "cubes":
        raise BadArgument(
            f"Cannot evaluate in the suite '{suite.name}'; expected one with the cubes: "
            f"{listing(known.name for known in SUITES if known.kind == 'cubes')}."
        )
    if arguments.condition not in CONDITIONS:
        raise unknown_name("condition", arguments.condition, CONDITIONS)
    if arguments.checkpoint == EXPERT and arguments.condition != "normal":
        raise BadArgument(
            f"The experts see no pictures and read no words: they have no condition '{arguments.condition}'."
        )
    for option in ("episodes", "workers", "max_steps", "replan_steps"):
        given = getattr(arguments, option)
        if given is not None and given < 1:
            raise BadArgument(f"Cannot use --{option.replace('_', '-')} {given}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"Cannot use --seed {arguments.seed}; expected at least 0.")
    if arguments.output is not None and not arguments.output.absolute().parent.is_dir():
        raise BadArgument(f"Cannot write '{arguments.output}': there is no folder '{arguments.output.parent}'.")
    tasks = list_tasks(suite)
    numbers = arguments.task_id if arguments.task_id is not None else list(range(suite.num_tasks))
    for number in numbers:
        check_task_id(suite, number)
        check_initial_state_index(tasks[number], arguments.episodes - 1)
        if arguments.condition == "switched":
            other_task(number)
    evaluation = Evaluation(
        checkpoint=arguments.checkpoint,
        suite=suite.name,
        max_steps=suite.max_steps if arguments.max_steps is None else arguments.max_steps,
        replan_steps=arguments.replan_steps,
        seed=arguments.seed,
    )
    return evaluation, [(task, state) for task in numbers for state in range(arguments.episodes)]


def _check_policy(evaluation: Evaluation) -> None:
    """Raise a `UserError` if the policy cannot be built, or gives fewer actions than are to be executed."""
    from vla_attention.capture.policies.pi.family import PiSettings
    from vla_attention.capture.policies.pi.loading import build_pi_policy

    policy = build_pi_policy(PiSettings(evaluation.checkpoint), "cpu")
    if (evaluation.replan_steps or 1) > policy.action_horizon:
        raise BadArgument(
            f"Cannot use --replan-steps {evaluation.replan_steps}: a policy call of '{evaluation.checkpoint}' gives "
            f"{policy.action_horizon} actions."
        )


@contextmanager
def _evaluating(evaluation: Evaluation, condition: Condition) -> Iterator[Callable[[Job], Iterator[Outcome]]]:
    """Give what runs an episode, in a process of its own."""
    import torch

    from vla_attention.capture.policies.pi.family import PiSettings
    from vla_attention.capture.policies.pi.loading import build_pi_policy

    torch.set_num_threads(1)
    is_expert = evaluation.checkpoint == EXPERT
    policy = None if is_expert else build_pi_policy(PiSettings(evaluation.checkpoint), "cpu")
    replan_steps = evaluation.replan_steps or (1 if policy is None else policy.default_replan_steps)
    protocol = cubes_protocol(evaluation.suite, evaluation.seed, replan_steps, evaluation.max_steps)
    tasks = list_tasks(find_suite(evaluation.suite))
    table: CubesEnvironment | None = None

    def run(job: Job) -> Iterator[Outcome]:
        nonlocal table
        number, state = job
        if table is None or CUBE_TASKS[table.task.task_id].num_cubes != CUBE_TASKS[number].num_cubes:
            if table is not None:
                table.close()
            table = CubesEnvironment(tasks[number], EnvironmentSettings())
        if policy is None:
            yield run_expert(table, tasks[number], state, protocol)
        else:
            yield run_episode(table, policy, tasks[number], state, protocol, condition)

    yield run


def describe(outcomes: Sequence[Outcome]) -> str:
    """Return a table of rates with 95 % intervals: solved, and the first touch at the named cube."""
    lines = [f"{'task':<28}{'n':>5}  {'solved':<24}{'first touch named':<24}{'steps':>6}"]
    groups: list[tuple[str, list[Outcome]]] = [
        (CUBE_TASKS[task].name, [o for o in outcomes if o.task == task]) for task in sorted({o.task for o in outcomes})
    ]
    if len(groups) > 1:
        groups.append(("all", list(outcomes)))
    for name, chosen in groups:
        count = len(chosen)
        solved, named = sum(o.success for o in chosen), sum(o.first_touched == o.named for o in chosen)
        steps = sum(o.steps for o in chosen) / count
        lines.append(f"{name:<28}{count:>5}  {_rate(solved, count):<24}{_rate(named, count):<24}{steps:>6.0f}")
    return "\n".join(lines)


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    z = 1.959964
    rate, square = successes / count, z * z / count
    middle = (rate + square / 2) / (1 + square)
    half = z * math.sqrt(rate * (1 - rate) / count + square / (4 * count)) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def _rate(successes: int, count: int) -> str:
    low, high = wilson_interval(successes, count)
    return f"{successes / count:.1%} [{low:.1%}, {high:.1%}]"


def _read(path: Path | None, evaluation: Evaluation) -> list[Outcome]:
    """Read the outcomes of a file; `BadArgument` if they are of another evaluation."""
    if path is None or not path.exists():
        return []
    try:
        content = read_object(path, BadArgument)
        of, episodes = dict(content["evaluation"]), [Outcome(**entry) for entry in content["episodes"]]
    except (OSError, ValueError, TypeError, KeyError):  # BadArgument is a ValueError, too
        raise BadArgument(
            f"Cannot go on with '{path}': it is no file of this command, or of a version that did not say what its "
            "episodes are of; give another --output."
        ) from None
    different = [
        f"{name.replace('_', ' ')} {of.get(name)}, not {value}"
        for name, value in asdict(evaluation).items()
        if of.get(name) != value
    ]
    if different:
        raise BadArgument(f"'{path}' has episodes of other settings ({listing(different)}); give another --output.")
    return episodes


def _write(path: Path, evaluation: Evaluation, outcomes: Sequence[Outcome]) -> None:
    content = {"evaluation": asdict(evaluation), "episodes": [asdict(outcome) for outcome in outcomes]}
    partial_file = path.with_name(f".{path.name}.partial")
    partial_file.write_text(json.dumps(content), encoding="utf-8")
    partial_file.replace(path)
