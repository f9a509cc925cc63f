"""Whether attention tells on what a policy acts, measured: see docs/validation.md.

    python -m benchmarks.validation POLICIES --shipped pi05_cubes --work DIR       about a folder of trained policies
    python -m benchmarks.validation POLICIES --shipped pi05_cubes --work DIR --page docs/validation.md     into the page
    python -m benchmarks.validation POLICIES --work DIR --reduced          two tasks and few calls: about a minute
    python -m benchmarks.validation --checkpoint PATH --suite libero_10 --work DIR --task-id 0 1 2      your own

POLICIES has one folder per trained policy (`python -m examples.cubes_policy export`). What is in DIR
already is not made again: a killed run goes on. DIR/results.json has all numbers, DIR/tables.md the tables.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import polars as pl

from benchmarks.validation.calls import spread_of, units_of
from benchmarks.validation.known import all_numbers, contrasts, known_numbers
from benchmarks.validation.mixing import mixing
from benchmarks.validation.page import fill_page, tables_text
from benchmarks.validation.pictures import draw
from benchmarks.validation.policies import SHIPPED, KnownPolicy, load_policy, read_policies, record, success
from benchmarks.validation.prediction import correlations, item_means, predicted_effects
from benchmarks.validation.success import CONDITIONS, CONTROL_CONDITIONS, success_under
from vla_attention.capture.environments.cubes.tasks import NUM_BASE_TASKS
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import BadArgument

#: Of an episode in the suites of cubes, where most are solved within half of them.
MAX_STEPS = 100
#: Of each task, and of each episode.
_EPISODES, _REPLANS = 1, 3
STAGES = ("known", "prediction", "mixing", "success")


@dataclass(frozen=True)
class Plan:
    """What is run. replans: of each episode. episodes, tasks: None and so on as in `vla-capture`."""

    policies: tuple[KnownPolicy, ...]
    shipped: KnownPolicy
    work: Path
    stages: tuple[str, ...]
    tasks: list[int] | None
    episodes: int
    replans: int
    max_steps: int | None
    conditions: tuple[str, ...] = tuple(CONDITIONS)[1:]
    control_rollouts: bool = True


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    return run_command(
        "benchmarks.validation", lambda: _run(argv), "what is in the folder of --work is kept; run again."
    )


def _run(argv: list[str] | None) -> int:
    arguments = _arguments(argv)
    plan = _plan(arguments)
    results = run(plan)
    plan.work.mkdir(parents=True, exist_ok=True)
    files = [plan.work / "results.json", plan.work / "tables.md"]
    files[0].write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    files[1].write_text(tables_text(results), encoding="utf-8")
    if arguments.page is not None:
        fill_page(arguments.page, results)
        beside = arguments.page.with_suffix("") / "results.json"
        beside.parent.mkdir(exist_ok=True)
        beside.write_text(files[0].read_text(encoding="utf-8"), encoding="utf-8")
        files += [arguments.page, beside, *draw(results, arguments.page.parent / "pictures")]
    else:
        files += draw(results, plan.work)
    for file in files:
        print(file)
    return 0


def run(plan: Plan) -> dict[str, Any]:
    """Run all stages; returns the results, which are plain JSON."""
    results: dict[str, Any] = {
        "settings": {"episodes": plan.episodes, "replans": plan.replans, "max_steps": plan.max_steps},
        "policies": [],
    }
    tables: dict[str, pl.DataFrame] = {}
    everything = [policy for policy in plan.policies if policy.checkpoint != plan.shipped.checkpoint]
    everything.insert(0, plan.shipped)
    success_rows: list[dict[str, Any]] = []
    for policy in everything:
        folder = plan.work / policy.name
        say(f"{policy.name}: rollouts in {policy.suite}")
        store = record(policy, folder / "base.zarr", plan.tasks, plan.episodes, plan.max_steps)
        facts = {"name": policy.name, "control": policy.control, "seed": policy.seed, "suite": policy.suite}
        facts |= success(store)
        model = load_policy(store.path)
        units = spread_of(store)
        if set(plan.stages) != {"success"}:
            units = units_of(model, store, folder / "units", say)
        facts["left_out"] = list(units.left_out)
        if "known" in plan.stages and policy.control:
            tables[policy.name], furthest = all_numbers(model, store, units, folder / "known", plan.replans, say)
            facts["rerun_difference"] = furthest
        shipped = policy.checkpoint == plan.shipped.checkpoint
        if "prediction" in plan.stages and shipped:
            table = predicted_effects(model, store, units, folder / "prediction", plan.replans, say)
            results |= {"prediction": correlations(table), "items": item_means(table)}
            results["prediction_everywhere"] = correlations(table, "everywhere")
        if "mixing" in plan.stages and shipped and not model.has_prefix:
            say("question 3 is left out: the policy has no prefix in which text and pictures read each other")
        elif "mixing" in plan.stages and shipped:
            results["mixing"] = mixing(model, store, units, folder / "mixing", plan.replans, say)
        if "success" in plan.stages:
            base = {"policy": policy.name, "control": policy.control, "condition": "nothing changed"}
            success_rows.append(base | success(store))
            cameras = [camera.name for camera in model.cameras]
            own = CONTROL_CONDITIONS.get(policy.control, ()) if policy.seed == 0 and plan.control_rollouts else ()
            which = plan.conditions if shipped else tuple(name for name in own if name in plan.conditions)
            success_rows += success_under(policy, cameras, folder, plan.tasks, 1, plan.max_steps, which, say)
        results["policies"].append({"rerun_difference": 0.0} | facts)
    if tables:
        results["known"] = known_numbers(everything, tables)
        results["contrasts"] = contrasts(everything, tables)
    if success_rows:
        results["success"] = success_rows
    return results


def _plan(arguments: argparse.Namespace) -> Plan:
    stages = tuple(arguments.stages)
    for option in ("num_episodes", "replans", "max_steps"):
        given = getattr(arguments, option)
        if given is not None and given < 1:
            raise BadArgument(f"--{option.replace('_', '-')} is {given}; it must be at least 1.")
    for option in ("num_episodes", "replans", "max_steps", "rollouts"):
        if arguments.reduced and getattr(arguments, option) is not None:
            raise BadArgument(
                f"--{option.replace('_', '-')} does not go with --reduced, which has its own numbers; leave one out."
            )
    if arguments.checkpoint is not None:
        shipped = KnownPolicy(
            Path(arguments.checkpoint).name, arguments.checkpoint, arguments.suite, family=arguments.family
        )
        policies: tuple[KnownPolicy, ...] = ()
        tasks = arguments.task_id
    else:
        if arguments.policies is None:
            raise BadArgument("Give a folder of trained policies, or --checkpoint with --suite.")
        policies = tuple(read_policies(arguments.policies))
        shipped = next((policy for policy in policies if policy.control == "words"), policies[0])
        if arguments.shipped is not None:
            name = Path(arguments.shipped).name
            shipped = KnownPolicy(name, arguments.shipped, "cubes", SHIPPED)
        tasks = arguments.task_id or list(range(NUM_BASE_TASKS))
    max_steps = arguments.max_steps or (MAX_STEPS if policies else None)
    episodes, replans = arguments.num_episodes or _EPISODES, arguments.replans or _REPLANS
    plan = Plan(policies, shipped, arguments.work, stages, tasks, episodes, replans, max_steps)
    if arguments.rollouts is not None:
        chosen = tuple(tuple(CONDITIONS)[number] for number in arguments.rollouts)
        plan = replace(plan, conditions=chosen, control_rollouts=False)
    if arguments.reduced:
        few = ("prompt empty", "without the instruction's words")
        plan = Plan(policies, shipped, arguments.work, stages, arguments.task_id or [0, 4], 1, 1, 10, few)
    return plan


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policies", type=Path, nargs="?", metavar="POLICIES", help="folder of trained policies")
    parser.add_argument(
        "--shipped", metavar="PATH", help="policy of questions 2 and 3 (default: the first of POLICIES that must read)"
    )
    parser.add_argument(
        "--checkpoint", help="a policy of your own, as for vla-attention capture pi, instead of POLICIES"
    )
    parser.add_argument("--family", default="pi", help="its family: pi (default) or cosmos")
    parser.add_argument("--suite", default="cubes", help="its suite (default: cubes)")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="folder of stores and results")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write tables and pictures into this page, too")
    parser.add_argument("--reduced", action="store_true", help="two tasks, ten steps, one policy call of each episode")
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES, help="default: all")
    parser.add_argument(
        "--rollouts",
        type=int,
        nargs="+",
        metavar="N",
        choices=range(1, len(CONDITIONS)),
        help="rollouts of the shipped policy alone, under these conditions of success.py, from 1 (default: all)",
    )
    parser.add_argument("--task-id", type=int, nargs="+", metavar="N", help="default: the base tasks; of your own: all")
    parser.add_argument("--num-episodes", type=int, metavar="N", help=f"of each task (default: {_EPISODES})")
    parser.add_argument("--replans", type=int, metavar="N", help=f"policy calls of each episode (default: {_REPLANS})")
    parser.add_argument("--max-steps", type=int, metavar="N", help=f"default: {MAX_STEPS}; of your own: the suite's")
    return parser.parse_args(argv)


def say(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
