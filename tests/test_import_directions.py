"""Imports between folders run downwards in the plan of CONTRIBUTING.md, which names every folder, and in no circle."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "vla_attention"

#: What the modules of each part may import of the others.
BELOW = {
    "schemas": set(),
    "capture": {"schemas"},
    "analyze": {"schemas"},
    "testing": {"schemas", "capture"},
    "example_stores": {"schemas"},
}


def plan() -> dict[str, int]:
    """Folders and files of the plan in CONTRIBUTING.md by their lines, `capture.store` for instance."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    lines = text.split("```")[1].splitlines()
    places, part = {}, ""
    for number, line in enumerate(lines):
        if named := re.match(r"(\w+)/ ", line):
            part = named[1]
        for name in (
            re.findall(r"(\w+)(?:/|\.py)", re.split(r"\s{2,}", line.strip())[0]) if line.startswith("  ") else ()
        ):
            places[f"{part}.{name}"] = number
    return places


PLAN = plan()


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


def line_of(module: str) -> float:
    """The line of the plan that has the module's folder, or the module."""
    parts = module.split(".")
    if parts[-1] == "__main__" or parts[0] not in ("capture", "analyze") or len(parts) < 2:
        return float("inf") if parts[-1] == "__main__" else 0
    assert ".".join(parts[:2]) in PLAN, f"{module} has no place: add its folder to the plan in CONTRIBUTING.md"
    return PLAN[".".join(parts[:2])]


def folder_of(module: str) -> str:
    """The folder of a module; a module that stands beside folders counts as one."""
    parts = module.split(".")
    if FILES[module].name != "__init__.py" and len(parts) > 2:
        parts.pop()
    return ".".join(parts[: 3 if parts[:2] == ["capture", "policies"] else 2])


@pytest.mark.parametrize("module", sorted(name for name in FILES if name))
def test_imports_run_downwards(module):
    part = module.split(".")[0]
    for name in imports(module):
        other = name.split(".")[0]
        assert other == part or other in BELOW[part], f"{module} imports {name}"
        if other == part:
            assert line_of(name) <= line_of(module), f"{module} imports {name}, which stands below it in the plan"


def test_the_plan_names_what_there_is():
    folders = {".".join(name.split(".")[:2]) for name in FILES if name.count(".") >= 1}
    for name in PLAN:
        if name.split(".")[0] in ("capture", "analyze"):
            assert name in folders, f"the plan in CONTRIBUTING.md has {name}, which there is not"


def test_no_circle_between_folders():
    graph: dict[str, set[str]] = {}
    for module in FILES:
        here = folder_of(module)
        graph.setdefault(here, set()).update({folder_of(name) for name in imports(module)} - {here})
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))
