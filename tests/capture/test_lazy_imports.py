"""`vla-capture --help` and its commands' help import no library."""

from __future__ import annotations

import pytest

from tests.kit.lazy_imports import help_without_libraries
from vla_attention.capture.policies.families import policy_families

COMMANDS = [
    [],
    *([family.name] for family in policy_families()),
    ["doctor"],
    ["parity"],
    ["repair"],
    ["rerun"],
    ["status"],
    ["tasks"],
    ["verify"],
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_imports_no_library(command):
    assert help_without_libraries("vla_attention.capture", [*command, "--help"]).startswith("usage: vla-capture")
