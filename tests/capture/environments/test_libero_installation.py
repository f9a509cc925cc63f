"""Finding LIBERO and its assets without questions, downloads or files in the home folder."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from vla_attention.capture.environments import libero_assets, libero_installation
from vla_attention.capture.environments.libero_assets import (
    ASSET_SUBFOLDERS,
    ASSETS_VARIABLE,
    LiberoAssetsMissing,
    compare_with_originals,
    find_assets,
)
from vla_attention.capture.environments.libero_installation import instruction_of
from vla_attention.capture.environments.suites import SUITES, find_suite, list_tasks
from vla_attention.schemas.errors import MissingDependency

try:
    libero_installation.package_folder()
except MissingDependency:
    pytest.skip("LIBERO is not installed", allow_module_level=True)


@pytest.fixture
def no_assets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine without assets: no variable, an empty home folder, and a package without assets."""
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(libero_assets, "package_folder", lambda: tmp_path / "libero")
    monkeypatch.setattr(libero_assets, "_WHEELS", "wheels_that_are_not_installed")
    return tmp_path


def asset_folder(folder: Path) -> Path:
    for name in ASSET_SUBFOLDERS:
        (folder / name).mkdir(parents=True)
    return folder


def test_assets_are_looked_for_in_order(no_assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    downloaded = asset_folder(no_assets / ".cache" / "libero" / "assets")
    assert find_assets(None) == downloaded
    own = asset_folder(no_assets / "libero" / "assets")
    assert find_assets(None) == own
    of_wheels = asset_folder(no_assets / "site" / "made_up_wheels" / "assets")
    for part in range(1, 6):
        (of_wheels.parent / f"part_{part}.py").touch()
    monkeypatch.syspath_prepend(no_assets / "site")
    monkeypatch.setattr(libero_assets, "_WHEELS", "made_up_wheels")
    assert find_assets(None) == of_wheels
    from_variable = asset_folder(no_assets / "variable")
    monkeypatch.setenv(ASSETS_VARIABLE, str(from_variable))
    assert find_assets(None) == from_variable
    configured = asset_folder(no_assets / "configured")
    assert find_assets(configured) == configured


def test_some_of_the_five_wheels_are_none(no_assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asset_folder(no_assets / "site" / "two_wheels" / "assets")
    for part in (1, 4):
        (no_assets / "site" / "two_wheels" / f"part_{part}.py").touch()
    monkeypatch.syspath_prepend(no_assets / "site")
    monkeypatch.setattr(libero_assets, "_WHEELS", "two_wheels")
    with pytest.raises(LiberoAssetsMissing, match=r"assets-2, \S+assets-3, \S+assets-5 "):
        find_assets(None)


def test_files_that_are_not_the_originals_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, content in (("same.xml", "<a/>"), ("other.xml", "<b/>")):
        (tmp_path / name).write_text(content)
    originals = tmp_path / "originals.txt"
    blob = "e7a4e7a7a9a8c26ba3a1a5d6c8d1e2b4b0e1d8f0"
    originals.write_text(f"BLOB same.xml\n{blob} other.xml\n{blob} folder/absent one.xml\n")
    made = subprocess.run(["git", "hash-object", "same.xml"], cwd=tmp_path, check=True, capture_output=True, text=True)
    originals.write_text(originals.read_text().replace("BLOB", made.stdout.strip()))
    monkeypatch.setattr(libero_assets, "_ORIGINALS", originals)
    assert compare_with_originals(tmp_path) == (3, ["folder/absent one.xml"], ["other.xml"])


def test_every_suite_lists_its_tasks() -> None:
    for suite in SUITES:
        tasks = list_tasks(suite)
        assert [task.task_id for task in tasks] == list(range(suite.num_tasks))
    first = list_tasks(find_suite("libero_spatial"))[0]
    assert first.instruction == "pick up the black bowl between the plate and the ramekin and place it on the plate"


@pytest.mark.parametrize(
    ("name", "instruction"),
    [
        ("KITCHEN_SCENE10_put_the_butter_in_the_drawer", "put the butter in the drawer"),
        ("open_the_middle_drawer_of_the_cabinet", "open the middle drawer of the cabinet"),
    ],
)
def test_instructions_come_from_names(name: str, instruction: str) -> None:
    assert instruction_of(name) == instruction
