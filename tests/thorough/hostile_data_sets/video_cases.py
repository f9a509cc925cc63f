"""Hostile videos."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.thorough.hostile_checkpoints.hostile_files import sparse
from tests.thorough.hostile_data_sets.made import VIDEO, Case, hostile
from tests.thorough.hostile_runs import Make


def changed(change: Callable[[bytes], bytes]) -> Make:
    def edit(robot: Path) -> None:
        path = robot / VIDEO
        path.write_bytes(change(path.read_bytes()))

    return hostile(edit, video=True)


NO_VIDEO = "is no video that can be read"

VIDEOS: dict[str, Case] = {
    "a video with holes": Case(hostile(lambda robot: sparse(robot / VIDEO, 2**40), video=True), NO_VIDEO),
    "a playlist": Case(changed(lambda content: b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/a.mp4\n"), NO_VIDEO),
}
