"""Finding and loading the LIBERO package: no questions, no downloads, no files in the home folder.

The published package asks on standard input for the places of its files, saves the answer in the home folder, and
downloads missing assets. A batch job can do none of this, so this module sets everything before the package can ask.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import importlib
import importlib.util
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from vla_attention.capture.environments.base import Suite, TaskTexts
from vla_attention.capture.environments.robosuite_installation import (
    import_robosuite,
    load_source,
    readable_device_choice,
)
from vla_attention.capture.environments.task_families import sentence_template
from vla_attention.schemas.errors import MissingDependency

#: LIBERO without what it declares (scripts/constraints.txt has the same versions).
_INSTALL = "pip install --no-deps hf-libero==0.1.4 bddl==1.0.1, or 'make setup' in a checkout"


@functools.cache
def package_folder() -> Path:
    """Return the folder of the inner package `libero.libero` without importing it."""
    spec = importlib.util.find_spec("libero")
    for location in (spec.submodule_search_locations or []) if spec else []:
        inner = Path(location) / "libero"
        if (inner / "benchmark" / "libero_suite_task_map.py").is_file():
            return inner
    raise MissingDependency(f"LIBERO (hf-libero) is not installed, and its task suites need it: {_INSTALL}.")


@functools.cache
def _task_names() -> dict[str, list[str]]:
    # The file holds one dictionary and imports nothing. An import by name would first import the packages above it,
    # which ask questions and load torch.
    path = package_folder() / "benchmark" / "libero_suite_task_map.py"
    names: dict[str, list[str]] = load_source("_libero_suite_task_map", path).libero_task_map
    return names


def instruction_of(task_name: str) -> str:
    """Return the instruction of a task: its name in words, without the scene at the beginning.

    The task files also hold a sentence, which differs for some tasks. The published evaluations use the name.
    """
    return re.sub(r"^[A-Z_]+SCENE\d+_", "", task_name).replace("_", " ")


def list_libero_tasks(suite: Suite) -> list[TaskTexts]:
    """Return a suite's tasks in the benchmark's default order; of LIBERO-PRO, which keeps it, those of the suite that
    it changes."""
    names = _task_names()[suite.perturbs or suite.name]
    if len(names) != suite.num_tasks:
        raise MissingDependency(
            f"The installed LIBERO has {len(names)} tasks in {suite.name} instead of {suite.num_tasks}; "
            "run 'make setup'."
        )
    return [(name, instruction_of(name), sentence_template(instruction_of(name))) for name in names]


@functools.cache
def load_libero(assets: Path) -> dict[str, Any]:
    """Import LIBERO's environments with these assets; return its environment classes by lower-case problem name."""
    import_robosuite()
    package = _import_with_own_configuration(assets)
    # LIBERO builds every asset path with `get_assets_path`. It returns this variable if the folder exists, without
    # searching elsewhere or downloading.
    package._assets_path_cache = str(assets)  # type: ignore[attr-defined]
    try:
        # The imports of gymnasium and of the packages above print advice that our users cannot follow.
        with readable_device_choice(), contextlib.redirect_stdout(io.StringIO()):
            environments = importlib.import_module("libero.libero.envs")
    except ImportError as error:
        raise MissingDependency(f"LIBERO could not be loaded ({error}): {_INSTALL}.") from error
    classes: dict[str, Any] = environments.TASK_MAPPING
    return classes


def _import_with_own_configuration(assets: Path) -> ModuleType:
    if "libero.libero" in sys.modules:
        return sys.modules["libero.libero"]
    folder = package_folder()
    configuration = tempfile.TemporaryDirectory(prefix="vla-libero-")
    atexit.register(configuration.cleanup)  # kept until exit, because the package reads the file repeatedly
    paths = {"benchmark_root": ".", "bddl_files": "bddl_files", "init_states": "init_files", "datasets": "../datasets"}
    content = {key: str(folder / relative) for key, relative in paths.items()} | {"assets": str(assets)}
    Path(configuration.name, "config.yaml").write_text(json.dumps(content))  # JSON is valid YAML
    before = os.environ.get("LIBERO_CONFIG_PATH")
    os.environ["LIBERO_CONFIG_PATH"] = configuration.name
    try:
        return importlib.import_module("libero.libero")
    except ImportError as error:
        raise MissingDependency(f"LIBERO could not be loaded ({error}): {_INSTALL}.") from error
    finally:
        if before is None:
            del os.environ["LIBERO_CONFIG_PATH"]
        else:
            os.environ["LIBERO_CONFIG_PATH"] = before
