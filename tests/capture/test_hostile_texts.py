"""Text of stores, data sets, checkpoints and files beside them stays text in whatever the capture commands print.

What is printed is printable, and no line of it is one that a text with a line end made up.
"""

from __future__ import annotations

import json
import logging
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.kit.stores import StoreSpec, reseal, reseal_root, write_store
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import BadArgument

FORGED = "FORGED: all whole"
#: Clears a screen, reverses the direction of writing, sets a title (C1), ends a line in five ways.
HOSTILE = f"x\x1b[2J\u202e\x9d0;t\x07\u200e\r\n{FORGED}\u2028{FORGED}\x85{FORGED}\x0b{FORGED}\n{FORGED}"


def check_output(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    said = captured.out + captured.err
    for line in said.split("\n"):
        assert line.isprintable(), repr(line)
        assert not line.strip().startswith(FORGED), said
    return said


def run(*arguments: object) -> int:
    return capture([str(argument) for argument in arguments])


def change(document: Path, make: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(document.read_text())
    make(content["attributes"])
    document.write_text(json.dumps(content))


def with_hostile_texts(store: Path) -> Path:
    """Texts of every kind that a store may hold and that are refused nowhere, and files beside them."""

    def root(attributes: dict[str, Any]) -> None:
        attributes["provenance"] = {"torch": HOSTILE, HOSTILE: "1"}

    def episode(attributes: dict[str, Any]) -> None:
        attributes["instruction"] = HOSTILE
        attributes["provenance"] |= {"torch": HOSTILE, HOSTILE: "1"}

    change(store / "zarr.json", root)
    reseal_root(store)
    for folder in sorted((store / "episodes").glob("task*")):
        change(folder / "zarr.json", episode)
        reseal(folder)
    (store / f"a\x1b[2J\n{FORGED}").write_text("foreign")
    (store / "episodes" / "task001_episode000" / f"b\x1b[2J\n{FORGED}").mkdir()
    (store / ".writing" / f"c\x1b[2J\n{FORGED}").mkdir(parents=True)
    worker = {"tag": HOSTILE, "host": HOSTILE, "process": 1, "process_start": "1", "process_space": "1"}
    lock = store / ".writing" / "task000_episode000.lock"
    lock.write_text(json.dumps(worker | {"slurm_job": "1", "job_name": HOSTILE}))
    return store


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = StoreSpec(tasks=(0, 1), episodes=2, replans=2)
    return with_hostile_texts(write_store(tmp_path_factory.mktemp("stores") / "a.zarr", spec=spec))


@pytest.fixture
def store(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original.parent, tmp_path / "stores")
    return tmp_path / "stores" / "a.zarr"


def damage(store: Path) -> None:
    change(store / "episodes" / "task000_episode001" / "zarr.json", lambda root: root.update({HOSTILE: HOSTILE}))


@pytest.mark.parametrize(
    "command",
    [("status", "--verify"), ("verify",), ("verify", "--repair", "--quick")],
)
@pytest.mark.parametrize("damaged", [False, True])
def test_what_looks_at_a_store(
    store: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...], damaged: bool
):
    if damaged:
        damage(store)
    assert run(*command, store) in (0, 1)
    said = check_output(capsys)
    if command == ("verify",) and not damaged:
        assert r"a\x1b[2J\nFORGED" in said
    if command[0] == "status":
        assert r"x\x1b[2J\u202e" in said


def test_errors_of_the_library():
    """Python prints an error's text as it is, in a script of somebody who uses the library."""
    text = str(BadArgument(HOSTILE))
    assert text.isprintable()
    assert text.count(FORGED) == HOSTILE.count(FORGED)
    with_table = str(CallsDoNotFit(f"a\x1b[2J\n{FORGED}"))
    assert with_table == f"a\\x1b[2J\n{FORGED}"


def test_errors_warnings_and_log_lines(capsys: pytest.CaptureFixture[str]):
    def fail() -> int:
        warnings.warn(HOSTILE, stacklevel=1)
        logging.getLogger(HOSTILE).warning("%s", HOSTILE.partition("\r")[0])
        raise BadArgument(HOSTILE)

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run_command("program", fail, "") == 2
    captured = capsys.readouterr().err
    assert all(line.isprintable() for line in captured.split("\n"))
    refusal = next(line for line in captured.split("\n") if line.startswith("program: "))
    assert refusal.count(FORGED) == HOSTILE.count(FORGED)
