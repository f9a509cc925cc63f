"""What the parts of the package import of one another."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "vla_attention"

#: What the modules of each part may import of the others.
BELOW = {
    "schemas": set(),
    "capture": {"schemas"},
    "analyze": {"schemas"},
    "example_stores": {"schemas"},
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


def test_imports_between_parts_run_downwards():
    wrong = []
    for module in FILES:
        part = module.split(".")[0]
        others = {name: name.split(".")[0] for name in imports(module)} if module else {}
        wrong += [(module, name) for name, other in others.items() if other not in {part, *BELOW[part]}]
    assert not wrong
