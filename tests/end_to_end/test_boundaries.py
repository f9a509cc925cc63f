"""Processes that end before some of their changes of files: what is there is whole, and the same again completes it.

`benchmarks/reliability.py kill` tries every boundary of a commit of the command line.
"""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from tests.kit.boundaries import end_before
from tests.kit.crashes import run_child
from tests.kit.durable_stores import SPEC, leftovers, store_bytes, write_store
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.store.merging import merge_stores
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

#: Boundaries of each kind of work; the last one is always among them.
SAMPLES = 3
LAST = "task000_episode001"


def capture(folder: Path) -> None:
    """Add the second episode."""
    write_store(folder / "a.zarr", mode="resume", spec=SPEC)


def copy(folder: Path) -> None:
    copy_store(open_store(folder / "a.zarr"), folder / "out.zarr", ())


def merge(folder: Path) -> None:
    if not (folder / "out.zarr").exists():  # it appears whole
        merge_stores([open_store(folder / name) for name in ("one.zarr", "other.zarr")], folder / "out.zarr")


WORK: dict[str, Callable[[Path], None]] = {"capture": capture, "copy": copy, "merge": merge}


def work_and_end(name: str, folder: Path, number: int) -> None:
    changes = end_before(folder, number)
    WORK[name](folder)
    (folder.parent / "changes").write_text(str(changes()))


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> Path:
    """Stores to begin with: one of two episodes, and each of these in a store of its own."""
    folder = tmp_path_factory.mktemp("begin")
    write_store(folder / "a.zarr", spec=SPEC)
    for name, left in (("one.zarr", "task000_episode000"), ("other.zarr", LAST)):
        shutil.copytree(folder / "a.zarr", folder / name)
        shutil.rmtree(folder / name / "episodes" / left)
    return folder


@pytest.mark.parametrize("name", WORK)
def test_a_process_that_ends_at_a_boundary_leaves_whole_stores(stores, tmp_path, name):
    def begin(number: int) -> Path:
        shutil.copytree(stores, tmp_path / f"{number}")
        if name == "capture":
            shutil.rmtree(tmp_path / f"{number}/a.zarr/episodes" / LAST)
        return tmp_path / f"{number}"

    whole = begin(-1)
    assert run_child(work_and_end, name, whole, -1) == 0
    total = int((tmp_path / "changes").read_text())
    assert total > 3 * SAMPLES
    given = ["one.zarr", "other.zarr"] if name == "capture" else ["a.zarr", "one.zarr", "other.zarr"]
    killed = 0
    for number in (*sorted(Random(name).sample(range(total - 1), SAMPLES - 1)), total - 1):
        folder = begin(number)
        code = run_child(work_and_end, name, folder, number)
        # Threads make some folders twice or once: the number of changes differs by a few.
        assert code == -signal.SIGKILL or (code == 0 and number >= total - 5), (number, code)
        killed += code != 0
        target = folder / ("a.zarr" if name == "capture" else "out.zarr")
        for store in [*given, *([target.name] if target.exists() else [])]:
            assert verify_store(open_store(folder / store)) == [], (number, store)
        WORK[name](folder)
        for store in (*given, target.name):
            assert store_bytes(folder / store) == store_bytes(whole / store), (number, store)
        assert leftovers(target) == []
    assert killed >= SAMPLES - 1
