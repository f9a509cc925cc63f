"""Finding and loading the LIBERO package and its assets: no questions, no downloads, nothing written at home.

The package as published asks on standard input where its files are, keeps the answer in the home folder, and downloads
its assets when it misses them. None of this suits a batch job, so everything it would ask is told beforehand.
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

from vla_attention.capture.environments.base import Task
from vla_attention.capture.environments.simulator import import_robosuite, readable_device_choice
from vla_attention.capture.environments.suites import Suite
from vla_attention.schemas.errors import MissingDependency, UserError

ASSETS_VARIABLE = "VLA_LIBERO_ASSETS"
ASSETS_SOURCE = "lerobot/libero-assets"
"""The dataset on the Hugging Face hub that the package itself (hf-libero) would download."""

ASSET_SUBFOLDERS = (
    "scenes",
    "textures",
    "articulated_objects",
    "stable_hope_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
)


class LiberoAssetsMissing(UserError, FileNotFoundError):
    """The LIBERO asset folder was not found, or what was given is not one."""


@functools.cache
def package_folder() -> Path:
    """Return the folder of the inner package `libero.libero` without importing it."""
    spec = importlib.util.find_spec("libero")
    for location in (spec.submodule_search_locations or []) if spec else []:
        inner = Path(location) / "libero"
        if (inner / "benchmark" / "libero_suite_task_map.py").is_file():
            return inner
    raise MissingDependency("LIBERO (hf-libero) is not installed, and its task suites need it; run 'make setup'.")


@functools.cache
def _task_names() -> dict[str, list[str]]:
    # The file holds one dictionary and imports nothing. Importing it by name would first import the packages above it,
    # which ask questions and load torch.
    path = package_folder() / "benchmark" / "libero_suite_task_map.py"
    spec = importlib.util.spec_from_file_location("_libero_suite_task_map", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.libero_task_map


def instruction_of(task_name: str) -> str:
    """Return the instruction that evaluations give: the task's name in words, without the scene it begins with.

    The task files hold a sentence too, and for some tasks it differs; the published evaluations use the name.
    """
    return re.sub(r"^[A-Z_]+SCENE\d+_", "", task_name).replace("_", " ")


def list_libero_tasks(suite: Suite) -> tuple[Task, ...]:
    """Return a suite's tasks in the benchmark's default order."""
    names = _task_names()[suite.name]
    if len(names) != suite.num_tasks:
        raise MissingDependency(
            f"The installed LIBERO has {len(names)} tasks in {suite.name} instead of {suite.num_tasks}; run 'make setup'."
        )
    return tuple(
        Task(suite.name, task_id, name, instruction_of(name), suite.initial_states_per_task)
        for task_id, name in enumerate(names)
    )


def find_assets(configured: Path | None) -> Path:
    """Return the asset folder: the configured one, else VLA_LIBERO_ASSETS, else the package's own or its download."""
    from_variable = os.environ.get(ASSETS_VARIABLE)
    for given, origin in ((configured, "--libero-assets"), (from_variable, ASSETS_VARIABLE)):
        if given:
            folder = Path(given).expanduser()
            absent = [name for name in ASSET_SUBFOLDERS if not (folder / name).is_dir()]
            if absent:
                problem = f"lacks {', '.join(absent)}" if folder.is_dir() else "does not exist"
                raise LiberoAssetsMissing(
                    f"The LIBERO asset folder '{folder}' ({origin}) {problem}; give the folder that holds "
                    f"{', '.join(ASSET_SUBFOLDERS)}, for example a copy of the hub dataset {ASSETS_SOURCE}."
                )
            return folder.resolve()
    own_places = (package_folder() / "assets", Path.home() / ".cache" / "libero" / "assets")
    for folder in own_places:
        if all((folder / name).is_dir() for name in ASSET_SUBFOLDERS):
            return folder
    raise LiberoAssetsMissing(
        f"No LIBERO assets (scenes, objects, textures) were found in {own_places[0]} or {own_places[1]}; download the "
        f"hub dataset {ASSETS_SOURCE} and give its folder with --libero-assets PATH or {ASSETS_VARIABLE}=PATH."
    )


def load_libero(assets: Path) -> dict[str, Any]:
    """Import LIBERO's environments, pointed at `assets`; return its environment classes by lower-case problem name."""
    import_robosuite()
    package = _import_with_own_configuration(assets)
    # Every asset path goes through `get_assets_path`, which answers from this variable as long as it names a folder
    # that exists; set, it neither looks elsewhere nor downloads.
    package._assets_path_cache = str(assets)  # type: ignore[attr-defined]
    try:
        # gymnasium's import, and that of the packages above, print advice that a user here can do nothing about.
        with readable_device_choice(), contextlib.redirect_stdout(io.StringIO()):
            environments = importlib.import_module("libero.libero.envs")
    except ImportError as error:
        raise MissingDependency(f"LIBERO could not be loaded ({error}); run 'make setup'.") from error
    return environments.TASK_MAPPING


def _import_with_own_configuration(assets: Path) -> ModuleType:
    if "libero.libero" in sys.modules:
        return sys.modules["libero.libero"]
    folder = package_folder()
    configuration = tempfile.TemporaryDirectory(prefix="vla-libero-")
    atexit.register(configuration.cleanup)  # kept until exit: the package reads the file again whenever it is asked
    paths = {"benchmark_root": ".", "bddl_files": "bddl_files", "init_states": "init_files", "datasets": "../datasets"}
    content = {key: str(folder / relative) for key, relative in paths.items()} | {"assets": str(assets)}
    Path(configuration.name, "config.yaml").write_text(json.dumps(content))  # JSON is YAML
    before = os.environ.get("LIBERO_CONFIG_PATH")
    os.environ["LIBERO_CONFIG_PATH"] = configuration.name
    try:
        return importlib.import_module("libero.libero")
    except ImportError as error:
        raise MissingDependency(f"LIBERO could not be loaded ({error}); run 'make setup'.") from error
    finally:
        if before is None:
            del os.environ["LIBERO_CONFIG_PATH"]
        else:
            os.environ["LIBERO_CONFIG_PATH"] = before
