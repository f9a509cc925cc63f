"""Whether attention tells on what a policy acts, measured on policies whose dependence is known: docs/validation.md.

    python -m benchmarks.validation POLICIES --work DIR                 about a folder of trained policies
    python -m benchmarks.validation POLICIES --work DIR --page docs/validation.md     and into the page
    python -m benchmarks.validation POLICIES --work DIR --reduced       two tasks and few calls: about a minute

POLICIES has one folder per trained policy (`python -m examples.cubes_policy export`); the shipped one is always there.
What is in DIR already is not made again: a killed run goes on. DIR/results.json has all numbers.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from benchmarks.validation.calls import NOTHING, units_of
from benchmarks.validation.numbers import NUMBERS, attention_numbers, effect_numbers
from benchmarks.validation.policies import SHIPPED, KnownPolicy, load_policy, read_policies, record, success
from benchmarks.validation.ranks import ranks
from benchmarks.validation.success import success_under
from benchmarks.validation.tables import fill_page
from vla_attention.capture.environments.cubes.tasks import NUM_BASE_TASKS
from vla_attention.schemas.command_line import run_command

#: The results that the page shows.
ROWS = Path(__file__).with_name("results.json")


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    return run_command(
        "benchmarks.validation", lambda: _run(argv), "what is in the folder of --work is kept; run again."
    )


def read_arguments(argv: list[str] | None, module: str, says: str | None) -> argparse.Namespace:
    """What the studies of trained policies are told: policies, work, page, reduced."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {module}", description=says, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policies", type=Path, metavar="POLICIES", help="folder of trained policies")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="folder of stores and results")
    parser.add_argument(
        "--page", type=Path, metavar="FILE", help="write tables into this page, and their rows beside us"
    )
    parser.add_argument("--reduced", action="store_true", help="two tasks, ten steps, one policy call of each episode")
    return parser.parse_args(argv)


def _run(argv: list[str] | None) -> int:
    given = read_arguments(argv, "benchmarks.validation", __doc__)
    policies = [KnownPolicy(SHIPPED, "pi05_cubes", "cubes", SHIPPED), *read_policies(given.policies)]
    tasks, replans, steps = ([0, 4], 1, 10) if given.reduced else (list(range(NUM_BASE_TASKS)), 2, 100)
    results = run(policies, given.work, tasks, replans, steps)
    path = given.work / "results.json"
    path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(path)
    if given.page is not None:
        fill_page(given.page, results)
        shutil.copy(path, ROWS)
    return 0


def run(policies: list[KnownPolicy], work: Path, tasks: list[int], replans: int, max_steps: int) -> dict[str, Any]:
    """Roll out and measure; returns the results, which are plain JSON. replans: policy calls of each episode."""
    results: dict[str, Any] = {"replans": replans, "max_steps": max_steps, "policies": [], "success": []}
    for policy in policies:
        folder = work / policy.name
        say(f"{policy.name}: rollouts in {policy.suite}")
        store = record(policy, folder / "base.zarr", tasks, max_steps)
        model = load_policy(store.path)
        units = units_of(model, store, folder / "units", say)
        numbers = attention_numbers(store) | effect_numbers(model, store, units, folder / "known", replans, say)
        facts = {"name": policy.name, "control": policy.control, "seed": policy.seed, "suite": policy.suite}
        facts |= success(store) | {"left_out": list(units.left_out), "rerun_difference": numbers[NOTHING]}
        results["policies"].append(facts | {"numbers": {name: numbers[name] for name in NUMBERS if name in numbers}})
        if policy.control == SHIPPED:
            results["ranks"] = ranks(model, store, units, folder / "ranks", replans, say)
        results["success"] += success_under(policy, folder, tasks, max_steps, say)
    return results


def say(line: str) -> None:
    """Print a line at once."""
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
