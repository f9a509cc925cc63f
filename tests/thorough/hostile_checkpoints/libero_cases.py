"""Hostile files of LIBERO: initial states, tasks, assets."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from tests.thorough.hostile_checkpoints.hostile_files import (
    NO_TORCH_FILE,
    TRACE,
    Case,
    executing_pickle,
    pipe,
    sparse,
    torch_zip,
)
from tests.thorough.hostile_runs import PACKAGES, Make
from vla_attention.capture.environments.libero_assets import ASSET_SUBFOLDERS

#: The first task of the suite.
SUITE, NUMBER = "libero_10", 0


def installed() -> Path:
    spec = importlib.util.find_spec("libero")
    assert spec is not None
    return Path(next(iter(spec.submodule_search_locations or []))) / "libero"


def task_name() -> str:
    names: dict[str, object] = {}
    exec((installed() / "benchmark" / "libero_suite_task_map.py").read_text(), names)
    name: str = names["libero_task_map"][SUITE][NUMBER]  # type: ignore[index]
    return name


def package(folder: Path) -> Path:
    """LIBERO as it is installed, by links, with folders of its own for the files of the task; returns the inner one."""
    inner = folder / PACKAGES / "libero" / "libero"
    inner.mkdir(parents=True)
    (inner.parent / "__init__.py").write_text("")  # the installed package would win against a folder without
    for entry in installed().iterdir():
        if entry.name not in ("init_files", "bddl_files", "__pycache__"):
            (inner / entry.name).symlink_to(entry)
    for kind, ending in (("init_files", "pruned_init"), ("bddl_files", "bddl")):
        (inner / kind / SUITE).mkdir(parents=True)
        file = f"{kind}/{SUITE}/{task_name()}.{ending}"
        shutil.copyfile(installed() / file, inner / file)
    return inner


def made(change: Callable[[Path, Path, Path], object], folder: Path) -> list[str]:
    """A task of LIBERO; the change gets its initial states, its task file and the folder of assets."""
    inner, assets = package(folder), folder / "assets"
    for name in ASSET_SUBFOLDERS:
        (assets / name).mkdir(parents=True)
    states = inner / "init_files" / SUITE / f"{task_name()}.pruned_init"
    change(states, inner / "bddl_files" / SUITE / f"{task_name()}.bddl", assets)
    arguments = [
        "pi",
        "--checkpoint",
        "untrained-tiny",
        "--device",
        "cpu",
        "--task-suite",
        SUITE,
        "--task-id",
        str(NUMBER),
    ]
    more = ["--num-episodes", "1", "--libero-assets", str(assets), "--output", str(folder / "store.zarr")]
    return [*arguments, *more]


def states(change: Callable[[Path], object]) -> Make:
    return lambda folder: made(lambda path, task, assets: change(path), folder)


def task(change: Callable[[Path], object]) -> Make:
    return lambda folder: made(lambda path, task, assets: change(task), folder)


def as_states(value: object) -> Make:
    return states(lambda path: torch.save(value, path))


def executing_task(path: Path) -> None:
    trace = path.parents[5] / TRACE
    call = f"__import__('pathlib').path('{trace}').touch()"  # the parser writes everything in small letters
    path.write_text(path.read_text().replace("(0.0 0.0)", f"({call} 0.0)", 1))


LIBERO: dict[str, Case] = {
    "initial states that execute": Case(
        states(lambda path: torch_zip(path, executing_pickle(path.parents[5]))), r"asks for \w+\.system.*nothing of it"
    ),
    "initial states that are a table": Case(as_states({"a": 1}), "holds no initial states"),
    "initial states of another scene": Case(as_states(np.zeros((50, 3))), "do not belong together|cannot be built"),
    "a pipe for initial states": Case(states(pipe), "no regular file"),
    "initial states of 5 GB": Case(states(lambda path: sparse(path, 5 * 10**9)), NO_TORCH_FILE),
    "a task that executes": Case(task(executing_task), "as an angle .*Nothing of it was executed"),
    "a task of parentheses": Case(task(lambda path: path.write_text("(" * 100_000 + ")" * 100_000)), "parentheses"),
    "a pipe for a task": Case(task(pipe), "no regular file"),
    "a pipe among the assets": Case(
        lambda folder: made(lambda path, file, assets: pipe(assets / "scenes" / "x.xml"), folder), "no regular file"
    ),
}
