"""The version stands in pyproject.toml; whatever repeats it says the same."""

from __future__ import annotations

import re
import tomllib

import vla_attention as va
from tests.kit.paths import ROOT
from vla_attention.schemas.errors import INSTALL_LIBERO

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_installed_version_is_that_of_pyproject():
    assert va.__version__ == PROJECT["version"]


def test_the_citation_has_the_version():
    assert re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE) == [
        PROJECT["version"]
    ]


def test_no_module_states_a_version_of_its_own():
    stated = re.compile(rf"""["']{re.escape(PROJECT["version"])}["']""")
    for folder in ("vla_attention", "schemas", "capture", "analyze"):
        for path in (ROOT / folder).rglob("*.py"):
            assert not stated.search(path.read_text(encoding="utf-8")), path


def test_the_sentence_about_libero_has_the_versions_of_the_requirements():
    pinned = [
        line for line in (ROOT / "requirements-libero.txt").read_text(encoding="utf-8").split("\n") if "==" in line
    ]
    assert f"pip install --no-deps {' '.join(pinned)}," in INSTALL_LIBERO


def test_every_extra_that_a_sentence_names_exists():
    named = set()
    for folder in ("vla_attention", "schemas", "capture", "analyze"):
        for path in (ROOT / folder).rglob("*.py"):
            named.update(re.findall(r"vla-attention\[(\w+)", path.read_text(encoding="utf-8")))
    assert "capture" in named
    assert named <= set(PROJECT["optional-dependencies"])
