"""Simulation environments behind one small interface; importing this loads no simulator."""

from vla_attention.capture.environments.base import (
    Environment,
    EnvironmentSettings,
    Observation,
    SceneObject,
    StepResult,
    Task,
)
from vla_attention.capture.environments.coverage import patch_coverage
from vla_attention.capture.environments.suites import (
    SUITES,
    Suite,
    check_task_id,
    find_suite,
    list_tasks,
    make_environment,
)

__all__ = [
    "SUITES",
    "Environment",
    "EnvironmentSettings",
    "Observation",
    "SceneObject",
    "StepResult",
    "Suite",
    "Task",
    "check_task_id",
    "find_suite",
    "list_tasks",
    "make_environment",
    "patch_coverage",
]
