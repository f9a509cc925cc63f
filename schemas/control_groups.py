"""The control groups of this process, as the kernel tells them: their limits count for threads and for memory."""

from __future__ import annotations

from pathlib import Path


def own_groups(root: Path, controller: str) -> dict[int, str]:
    """Return the version of each tree of control groups that limits `controller`, and this process's group there.

    controller: `cpu` or `memory`. root: folder in place of /, for tests.
    """
    paths = {}
    for line in text_of(root / "proc/self/cgroup").splitlines():
        number, controllers, path = line.split(":", 2)
        if number == "0" and not controllers:
            paths[2] = path
        elif controller in controllers.split(","):
            paths[1] = path
    return paths


def text_of(path: Path) -> str:
    """Return the text of a file of the kernel; empty where there is none, or it is not for us."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
