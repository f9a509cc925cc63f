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


@pytest.mark.parametrize("function", ["evaluate_attention_ratio", "evaluate_attention_ratio_cosmos"])
def test_help_of_the_published_scripts_imports_no_library(function):
    printed = help_without_libraries("vla_attention.capture.__main__", ["--help"], function)
    assert printed.startswith(f"usage: {function.replace('_', '-')}")
