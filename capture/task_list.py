"""`vla-capture tasks`: the tasks of a suite."""

from __future__ import annotations

from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, find_suite, list_tasks
from vla_attention.schemas.errors import BadArgument


def print_tasks(suite_name: str, array: bool) -> int:
    """Print a line per task, or with `array` only the range of ids (which needs no simulator: login nodes have none)."""
    if array:
        names = STANDARD_SUITES if suite_name == ALL_SUITES else (suite_name,)
        print(f"0-{sum(find_suite(name).num_tasks for name in names) - 1}")
        return 0
    if suite_name == ALL_SUITES:
        raise BadArgument(f"'{ALL_SUITES}' is for --array only; name one suite.")
    for task in list_tasks(find_suite(suite_name)):
        print(f"{task.task_id:>3}  {task.instruction}")
    return 0
