"""Neither `--help` nor an import waits for a library: what is imported is looked at, no time is measured."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.kit.lazy_imports import HEAVY, help_without_libraries
from vla_attention.analyze.registry import COMMANDS


@pytest.mark.thorough
@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_no_library(command):
    assert help_without_libraries("vla_attention.analyze", [command, "--help"]).startswith("usage:")


def test_importing_the_package_imports_no_library():
    code = f"import sys, vla_attention as va; print([name for name in {HEAVY!r} if name in sys.modules], va.open)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("[] <function open")
