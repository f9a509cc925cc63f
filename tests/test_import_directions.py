"""Imports between folders run downwards and in no circle: the plan of the house in CONTRIBUTING.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from vla_attention.analyze.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "vla_attention"

#: Folders (or modules beside them) by level. A module imports from its own folder, its own level and lower levels.
LEVELS = {
    "schemas": 0,
    "analyze.commands": 0,
    "analyze.stores": 1,
    "analyze.statistics": 1,
    "analyze.show": 1,
    "analyze.measures": 2,
    "analyze.arguments": 3,
    **{f"analyze.{command}": 4 for command in COMMANDS},
    "analyze.cache": 1,
    "analyze.cache.command": 4,
    "analyze.published": 3,
    "analyze.parse": 5,
    "analyze.report": 5,
    "analyze.view": 5,
    "analyze.api": 6,
    "analyze.command_line": 7,
    "analyze.__main__": 8,
    "capture.environments": 1,
    "capture.store": 1,
    "capture.foreign_files": 1,
    "capture.memory": 1,
    "capture.provenance": 1,
    "capture.interventions": 3,
    "capture.recording": 2,
    "capture.jobs": 3,
    "capture.policies": 3,
    "capture.torch_policies": 4,
    "capture.rollout": 4,
    "capture": 5,
    "capture.published": 6,
    "capture.__main__": 7,
    "capture.small_policy": 6,
    "testing": 2,
    "example_stores": 1,
}


def module_files() -> dict[str, Path]:
    """Every module of the package by its name without `vla_attention.`."""
    files = {}
    for path in (ROOT / PACKAGE).glob("*"):
        for file in path.resolve().rglob("*.py"):
            parts = (path.name, *file.relative_to(path.resolve()).with_suffix("").parts)
            files[".".join(part for part in parts if part != "__init__")] = file
    return files


FILES = module_files()


def imports(module: str) -> Iterator[str]:
    """The package's modules that a module imports, wherever in the file."""
    for node in ast.walk(ast.parse(FILES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            named = node.module or ""
            found = [f"{named}.{alias.name}" for alias in node.names]
            found = [name if name.removeprefix(f"{PACKAGE}.") in FILES else named for name in found]
        elif isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        else:
            continue
        for name in found:
            imported = name.removeprefix(f"{PACKAGE}.")
            if imported != name:
                yield imported


def level_of(module: str) -> int:
    """The level of the longest entry of `LEVELS` that holds the module."""
    entries = [name for name in LEVELS if module == name or module.startswith(f"{name}.")]
    assert entries, f"{module} has no level: add its folder to LEVELS and to the plan in CONTRIBUTING.md"
    return LEVELS[max(entries, key=len)]


def folder_of(module: str) -> str:
    """The folder of a module; a module that stands beside folders counts as one."""
    parts = module.split(".")
    if FILES[module].name != "__init__.py" and len(parts) > 2:
        parts.pop()
    return ".".join(parts[: 3 if parts[:2] == ["capture", "policies"] else 2])


@pytest.mark.parametrize("module", sorted(name for name in FILES if name))
def test_imports_run_downwards(module):
    upwards = [name for name in imports(module) if level_of(name) > level_of(module)]
    assert not upwards, f"{module} imports from higher levels: {upwards}"


def test_capture_and_analyze_never_import_each_other():
    for module in FILES:
        stages = {name.split(".")[0] for name in imports(module)} & {"capture", "analyze"}
        assert stages <= {module.split(".")[0]} or (module.split(".")[0] == "testing" and stages <= {"capture"}), module


def test_no_circle_between_folders():
    graph: dict[str, set[str]] = {}
    for module in FILES:
        here = folder_of(module)
        graph.setdefault(here, set()).update({folder_of(name) for name in imports(module)} - {here})
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
