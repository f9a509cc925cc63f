"""`vla-capture tasks SUITE`: the tasks of a suite."""

from __future__ import annotations

import argparse

from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, find_suite, list_tasks
from vla_attention.capture.jobs.termination import Termination
from vla_attention.schemas.errors import BadArgument


def run_tasks_command(arguments: argparse.Namespace, termination: Termination) -> int:
    """Print a line per task, or with `--array` the range of task ids, which needs no simulator (login nodes)."""
    if arguments.array:
        names = STANDARD_SUITES if arguments.suite == ALL_SUITES else (arguments.suite,)
        print(f"0-{sum(find_suite(name).num_tasks for name in names) - 1}")
        return 0
    if arguments.suite == ALL_SUITES:
        raise BadArgument(f"'{ALL_SUITES}' is for --array only; name one suite.")
    for task in list_tasks(find_suite(arguments.suite)):
        print(f"{task.task_id:>3}  {task.instruction}")
    return 0
