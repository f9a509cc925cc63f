"""How much code there is, by folder: `python scripts/code_size.py [BEFORE]`, with a commit to hold it against.

Counted are lines without docstrings, comments, imports and blank lines, of the package's Python files. Files are those
without `__init__.py`. `alone`: modules that one other imports. `once`: private functions of at most six lines that are
called once in their file.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import tarfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("schemas", "capture", "analyze", "vla_attention")
#: Left the package for `examples/`, and counts on neither side.
LEFT = "capture/small_policy/"


@dataclass(frozen=True)
class Module:
    """A file. lines: of code. imported: names of modules."""

    path: str
    lines: int
    imported: frozenset[str]
    once: int

    @property
    def room(self) -> str:
        """The folder that it is counted under."""
        return "/".join(self.path.split("/")[: 2 if self.path.count("/") > 1 else 1])


def read(path: str, text: str) -> Module:
    """Count a file."""
    tree = ast.parse(text)
    left_out: set[int] = set()
    imported: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            left_out |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
            if isinstance(node, ast.ImportFrom) and node.module:
                imported |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                left_out |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    code = [
        number
        for number, line in enumerate(text.splitlines(), start=1)
        if number not in left_out and line.strip() and not line.strip().startswith("#")
    ]
    called = Counter(re.findall(r"\b_[a-z]\w*", text))
    once = sum(
        isinstance(node, ast.FunctionDef)
        and node.name.startswith("_")
        and not node.name.startswith("__")
        and called[node.name] == 2
        and (node.end_lineno or 0) - node.body[0].lineno < 6
        for node in ast.walk(tree)
    )
    return Module(path, len(code), frozenset(imported), once)


def modules_of(commit: str | None) -> list[Module]:
    """Return the modules of a commit; None: of the checkout."""
    if commit is None:
        texts = {
            str(file.relative_to(ROOT)): file.read_text() for name in FOLDERS for file in (ROOT / name).rglob("*.py")
        }
    else:
        archive = subprocess.run(["git", "archive", commit, *FOLDERS], cwd=ROOT, capture_output=True, check=True).stdout  # noqa: S607
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            texts = {
                member.name: file.read().decode()
                for member in files
                if member.name.endswith(".py") and (file := files.extractfile(member)) is not None
            }
    kept = {path: text for path, text in texts.items() if "node_modules" not in path and not path.startswith(LEFT)}
    return [read(path, text) for path, text in sorted(kept.items())]


def table(modules: list[Module]) -> dict[str, tuple[int, int, int, int, int, int]]:
    """Return for each room: lines, files, median and longest file in all its lines, modules alone, functions once."""
    importers: Counter[str] = Counter()
    names = {
        f"vla_attention.{module.path.removeprefix('vla_attention/')[:-3].replace('/', '.')}": module
        for module in modules
    }
    for module in modules:
        importers.update(name for name in module.imported if name in names)
    rooms: dict[str, list[Module]] = {}
    for module in modules:
        for room in (module.room, module.room.split("/")[0], "all"):
            rooms.setdefault(room, [])
            if module not in rooms[room]:
                rooms[room].append(module)
    found = {}
    for room, members in sorted(rooms.items()):
        files = [module for module in members if not module.path.endswith("__init__.py")]
        lengths = [module.lines for module in files] or [0]
        alone = sum(importers[name] == 1 for name, module in names.items() if module in files)
        once = sum(module.once for module in members)
        lines = sum(module.lines for module in members)
        found[room] = (lines, len(files), int(median(lengths)), max(lengths), alone, once)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", nargs="?", help="a commit")
    now, before = table(modules_of(None)), {}
    if (commit := parser.parse_args().before) is not None:
        before = table(modules_of(commit))
    print(f"{'folder':26}{'code':>14}{'files':>12}{'median':>12}{'longest':>12}{'alone':>12}{'once':>12}")
    for room in sorted(now | before):
        sides = [side[room] for side in (before, now) if room in side]
        cells = [" > ".join(str(side[column]) for side in sides) for column in range(6)]
        print(f"{room:26}{cells[0]:>14}" + "".join(f"{cell:>12}" for cell in cells[1:]))


if __name__ == "__main__":
    main()
