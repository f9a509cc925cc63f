"""`--help` waits for no library: what it imports is looked at, no time is measured."""

from __future__ import annotations

import subprocess
import sys

import pytest

from vla_attention.analyze.commands import COMMANDS

#: Each takes a tenth of a second or more to import.
HEAVY = ("numpy", "polars", "zarr", "matplotlib", "tqdm", "xarray", "pandas", "torch")
_CHECK = """
import runpy, sys
sys.argv = {argv!r}
try:
    runpy.run_module({module!r}, run_name="__main__")
except SystemExit as end:
    assert not end.code, end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
assert not heavy, heavy
"""


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("vla_attention.analyze.published.command", ["--help"]),
        ("vla_attention.analyze", ["--help"]),
        *(("vla_attention.analyze", [command, "--help"]) for command in COMMANDS),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_help_imports_no_library(module, words):
    code = _CHECK.format(argv=[module, *words], module=module, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:")
    assert "examples:" in done.stdout or words == ["verify", "--help"]


def test_importing_the_package_imports_no_library():
    code = f"import sys, vla_attention as va; print([name for name in {HEAVY!r} if name in sys.modules], va.open)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("[] <function open")
