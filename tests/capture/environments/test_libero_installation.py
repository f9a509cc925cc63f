"""Finding LIBERO and its assets without questions, downloads or files in the home folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.capture.environments import libero_installation
from vla_attention.capture.environments.libero_installation import (
    ASSET_SUBFOLDERS,
    ASSETS_VARIABLE,
    find_assets,
    instruction_of,
)
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
    monkeypatch.setattr(libero_installation, "package_folder", lambda: tmp_path / "libero")
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
    from_variable = asset_folder(no_assets / "variable")
    monkeypatch.setenv(ASSETS_VARIABLE, str(from_variable))
    assert find_assets(None) == from_variable
    configured = asset_folder(no_assets / "configured")
    assert find_assets(configured) == configured


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
