"""The control group of this process, as the kernel tells it: its limits count for threads and for memory."""

from __future__ import annotations

import re
from pathlib import Path


def of_own_group(name: str, root: Path = Path("/")) -> str:
    """Return the text of a file of this process's control group (version 2), such as `cpu.max`; empty without one.

    root: folder in place of /, for tests.
    """
    own = re.search(r"^0::/(.*)$", text_of(root / "proc/self/cgroup"), re.MULTILINE)
    if own is None:
        return ""
    mount = root / "sys/fs/cgroup"
    # A container may see the path of its group on the host, and the group itself in the place of the whole tree.
    return text_of(mount / own[1] / name) or text_of(mount / name)


def text_of(path: Path) -> str:
    """Return the text of a file of the kernel; empty where there is none, or it is not for us."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
