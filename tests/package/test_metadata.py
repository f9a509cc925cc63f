"""The version stands in pyproject.toml; the installed package says the same."""

from __future__ import annotations

import tomllib

import vla_attention as va
from tests.kit.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_installed_version_is_that_of_pyproject():
    assert va.__version__ == PROJECT["version"]
