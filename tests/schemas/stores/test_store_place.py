"""The room for a store: bytes, and the inodes that every file and folder takes."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.store.disk_estimate import DiskEstimate, describe
from vla_attention.schemas.command_line import describe_os_error
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_place import check_writable, room_at, why_refused

#: Inodes of a file system and those that are left -> what may still be made; None: it says nothing.
ROOMS = {(0, 0): None, (5000, 0): 0, (5000, 4000): 4000, (5_000_000, 4_000_000): 4_000_000}


@pytest.fixture(params=ROOMS, ids=str)
def inodes(request, monkeypatch) -> int | None:
    """The room of every file system."""
    total, left = request.param
    blocks = {"f_frsize": 1000, "f_blocks": 10**6, "f_bfree": 419_000, "f_bavail": 419_000}
    monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(f_files=total, f_favail=left, **blocks))
    return ROOMS[request.param]


def test_the_room_is_that_of_the_nearest_folder(tmp_path: Path, inodes: int | None):
    room = room_at(tmp_path / "a" / "b.zarr")
    assert room.inodes == inodes
    assert room.describe() == ("419 MB" if inodes is None else f"419 MB and {inodes:,} inodes")


def test_the_line_before_a_run_warns_of_more_files_than_inodes(tmp_path: Path, inodes: int | None):
    line = describe(DiskEstimate(10, 10, num_episodes=85, inodes_per_episode=57, episode_overhead=10), tmp_path)
    assert re.search(r"\b4,845 .*\b57 ", line)
    assert ("WARNING" in line) == (inodes in (0, 4000))


def test_a_full_inode_table_is_said_before_a_run_and_by_doctor(tmp_path: Path, inodes: int | None, capsys):
    store = tmp_path / "a.zarr"
    if inodes == 0:
        with pytest.raises(BadArgument, match="inode"):
            check_writable(store, "--output")
    else:
        check_writable(store, "--output")
    capture(["doctor", "pi", "--task-suite", "robosuite", "--output", str(store)])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if " disk " in line[:20])
    assert line.startswith("MISSING" if inodes == 0 else "ok")
    assert (" inode" in line) == (inodes is not None)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EACCES])
def test_an_error_says_whether_bytes_or_inodes_are_used_up(tmp_path: Path, inodes: int | None, code: int):
    error = OSError(code, os.strerror(code), str(tmp_path / "a" / "file"))
    said = why_refused(error, tmp_path)
    assert said in describe_os_error(error)
    assert said.startswith(os.strerror(code))
    is_full = code != errno.EACCES
    assert ("all inodes" in said) == (is_full and inodes == 0)
    assert ("quotas" in said) == (is_full and inodes != 0)
