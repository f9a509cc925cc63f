"""`--help` waits for no library: what it imports is looked at, no time is measured."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.kit.lazy_imports import HEAVY, help_without_libraries
from vla_attention.analyze.commands import COMMANDS


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("vla_attention.analyze.parse.command", ["--help"]),
        ("vla_attention.analyze", ["--help"]),
        *(("vla_attention.analyze", [command, "--help"]) for command in COMMANDS),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_help_imports_no_library(module, words):
    printed = help_without_libraries(module, words)
    assert printed.startswith("usage:")
    assert "examples:" in printed


def test_importing_the_package_imports_no_library():
    code = f"import sys, vla_attention as va; print([name for name in {HEAVY!r} if name in sys.modules], va.open)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("[] <function open")
