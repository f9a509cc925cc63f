"""`schemas` is the bottom of the package: it imports neither stage, and loads zarr only when an array is opened."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import vla_attention.schemas as schemas

FOLDER = Path(schemas.__file__).parent
MODULES = sorted(path for path in FOLDER.rglob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def test_schemas_import_no_stage():
    assert len(MODULES) > 15
    for path in MODULES:
        own = {name for name in imported(path) if name.startswith("vla_attention")}
        assert all(name.startswith("vla_attention.schemas") for name in own), (path, own)


def test_importing_every_module_loads_no_array_library():
    names = [
        "vla_attention.schemas." + ".".join(path.relative_to(FOLDER).with_suffix("").parts)
        for path in MODULES
        if path.name not in ("__init__.py", "sealed_zarr.py")
    ]
    code = (
        "import importlib, json, sys\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
        "heavy = ('zarr', 'numcodecs', 'google_crc32c', 'polars', 'torch')\n"
        "print(json.dumps([name for name in heavy if name in sys.modules]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
