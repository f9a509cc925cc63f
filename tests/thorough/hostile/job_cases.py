"""Claims and records beside a store: whoever gives a store away can put any file there."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.kit.attacks import FIRST
from tests.thorough.hostile.changes import Case, edit, episode_of

STATUS, REPAIR = ("status", "STORE"), ("repair", "STORE")
WORKER = {"tag": "x", "host": "node7", "process": 1, "process_start": "1", "process_space": "1"}
IGNORED = "1 record in .*a.zarr.jobs/runs cannot be read and is ignored: x.json"
MOVED = "1 of 1 episodes is damaged.*moved to "


def _record(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """A record of a worker."""

    def change(store: Path) -> None:
        folder = store.with_name("a.zarr.jobs") / "runs"
        folder.mkdir(parents=True)
        make(folder / "x.json")

    return change


def _claim(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """A claim on the damaged episode, which nobody has touched for long."""

    def change(store: Path) -> None:
        edit(episode_of(store) / "zarr.json", lambda attributes: attributes.update(num_steps=0))
        folder = store.with_name("a.zarr.jobs") / "claims" / f"{FIRST}.0"
        folder.mkdir(parents=True)
        make(folder / "owner.json")
        os.utime(folder / "owner.json", (0, 0), follow_symlinks=False)

    return change


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _to_fifo(path: Path) -> None:
    os.mkfifo(path.with_name("fifo"))
    path.symlink_to("fifo")


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10**12)


def _planned(*episodes: int) -> Callable[[Path], None]:
    """A record of this store whose tasks have so many episodes."""

    def make(path: Path) -> None:
        store = path.parents[1].with_name("a.zarr")
        document: dict[str, Any] = {
            "store": str((store / "zarr.json").stat().st_mtime_ns // 1000),
            "worker": WORKER,
            "plan": [{"task_id": i, "name": "x", "instruction": "x", "episodes": n} for i, n in enumerate(episodes)],
            "began": "2026-01-01T00:00:00+00:00",
            "state": "finished",
        }
        path.write_text(json.dumps(document))

    return _record(make)


JOB_CASES = [
    Case("record: a FIFO", _record(os.mkfifo), rf"{IGNORED} \(it is a FIFO and no regular file\)", STATUS, 0),
    Case("record: a link to a FIFO", _record(_to_fifo), rf"{IGNORED} \(it is a link", STATUS, 0),
    Case("record: a device", _record(_device), rf"{IGNORED} \(it is a link and no regular file\)", STATUS, 0),
    Case("record: a folder", _record(Path.mkdir), rf"{IGNORED} \(it is a folder", STATUS, 0),
    Case("record: a terabyte", _record(_sparse), rf"{IGNORED} \(it has 1,000,000,000,000 bytes", STATUS, 0),
    Case("record: deep lists", _record(lambda path: path.write_text("[" * 10**6)), IGNORED, STATUS, 0),
    Case("record: 10^15 planned episodes", _planned(10**15), IGNORED, STATUS, 0),
    Case(
        "record: 10^8 planned episodes of several tasks",
        _planned(*[10**6] * 100),
        "records plan 100,000,000 episodes; expected at most 1,000,000",
        STATUS,
    ),
    Case("claim: a FIFO", _claim(os.mkfifo), MOVED, REPAIR, 0),
    Case("claim: a link to a FIFO", _claim(_to_fifo), "claimed: .* by an unknown machine", REPAIR, 1),
    Case("claim: a device", _claim(_device), "1 of 1 episodes is damaged", REPAIR, 0),
    Case("claim: a terabyte", _claim(_sparse), MOVED, REPAIR, 0),
]
