"""`evaluate`: how often a policy solves the tasks of the suite `cubes`, in several processes, without recording."""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from tqdm import tqdm

from vla_attention.capture.environments.base import EnvironmentSettings, Suite, check_initial_state_index, check_task_id
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.environments.suites import SUITES, find_suite, list_tasks
from vla_attention.capture.foreign_files.json_objects import read_object
from vla_attention.capture.small_policy.processes import share_among_processes
from vla_attention.capture.small_policy.rollouts import (
    CONDITIONS,
    Condition,
    Outcome,
    RolloutSettings,
    other_task,
    run_episode,
    run_expert,
)
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.stores.store_place import refuse_in_store

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
        work = partial(_evaluate, evaluation, condition)
        complete = share_among_processes(work, missing, arguments.workers, keep, bar)
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
    from vla_attention.capture.policies.pi.build import build_pi_policy

    policy = build_pi_policy(evaluation.checkpoint, tokenizer=None, device="cpu")
    if (evaluation.replan_steps or 1) > policy.action_horizon:
        raise BadArgument(
            f"Cannot use --replan-steps {evaluation.replan_steps}: a policy call of '{evaluation.checkpoint}' gives "
            f"{policy.action_horizon} actions."
        )


def _evaluate(
    evaluation: Evaluation, condition: Condition, jobs: Sequence[Job], results: multiprocessing.Queue[Outcome]
) -> None:
    import torch

    from vla_attention.capture.policies.pi.build import build_pi_policy

    torch.set_num_threads(1)
    is_expert = evaluation.checkpoint == EXPERT
    policy = None if is_expert else build_pi_policy(evaluation.checkpoint, tokenizer=None, device="cpu")
    replan_steps = evaluation.replan_steps or (1 if policy is None else policy.default_replan_steps)
    settings = RolloutSettings(evaluation.max_steps, replan_steps, evaluation.seed, condition)
    tasks = list_tasks(find_suite(evaluation.suite))
    environment: CubesEnvironment | None = None
    cubes = 0
    for number, state in jobs:
        if environment is None or cubes != CUBE_TASKS[number].num_cubes:
            if environment is not None:
                environment.close()
            environment = CubesEnvironment(tasks[number], EnvironmentSettings())
            cubes = CUBE_TASKS[number].num_cubes
        if policy is None:
            results.put(run_expert(environment, tasks[number], state, settings))
        else:
            results.put(run_episode(environment, policy, tasks[number], state, settings))
    if environment is not None:
        environment.close()


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    z = 1.959964
    rate, square = successes / count, z * z / count
    middle = (rate + square / 2) / (1 + square)
    half = z * math.sqrt(rate * (1 - rate) / count + square / (4 * count)) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


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


def _rate(successes: int, count: int) -> str:
    low, high = wilson(successes, count)
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
