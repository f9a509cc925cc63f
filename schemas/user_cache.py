"""The folder of this user in which the package keeps what it can do without."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache(name: str) -> Path:
    """A folder of the user's cache: below `XDG_CACHE_HOME`, or ~/.cache. It is not made.

    Raises:
        RuntimeError: nobody knows where the user's home is.
    """
    return Path(os.environ.get("XDG_CACHE_HOME", "") or Path.home() / ".cache") / "vla-attention" / name
