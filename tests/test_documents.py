"""The documents name files, modules, commands and make targets that exist."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from vla_attention.analyze.commands import COMMANDS
from vla_attention.capture.policies.families import policy_families

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [path for path in (*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md"))) if path.is_file()]
#: Folders at the top of the checkout: a path in backticks that begins with one of these must exist.
TOP_FOLDERS = sorted(path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith("."))
#: Folders that runs make.
MADE = ("runs", "results", "build", "dist")


def text_of(document: Path) -> str:
    return document.read_text(encoding="utf-8")


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:  # the part before the last dot is a module without submodules
        holder, _, attribute = name.rpartition(".")
        return hasattr(import_module(holder), attribute)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_to_files(document):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text_of(document)):
        assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_paths_in_backticks_exist(document):
    folders = "|".join(re.escape(name) for name in TOP_FOLDERS if name not in MADE)
    for path in re.findall(rf"`((?:{folders})/[\w./-]*)`", text_of(document)):
        written = re.sub(r"[^/]*\b(NAME|FOLDER)\b.*", "", path)  # the folder above a placeholder
        assert (ROOT / written).exists(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_modules_and_what_they_hold_exist(document):
    for name in re.findall(r"\bvla_attention(?:\.\w+)+", text_of(document)):
        assert exists(name), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_make_targets_exist(document):
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for block in re.findall(r"```bash\n(.*?)```|`(make [^`]*)`", text_of(document), re.DOTALL):
        for target in re.findall(r"\bmake ([a-z][\w-]*)", "\n".join(block)):
            assert target in targets, target


def test_the_readme_names_every_command_family_and_method():
    readme = text_of(ROOT / "README.md")
    for command in COMMANDS:
        assert re.search(rf"^\| .*`{command}( A B)?`", readme, re.MULTILINE), command
    for family in policy_families():
        assert f"vla-capture {family.name}" in readme, family.name
