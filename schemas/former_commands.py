"""Commands that are parts of others now; what was typed for them goes on working, and the new words are said."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from vla_attention.schemas.errors import Note

#: The commands of before.
FORMER = ("merge", "repair")


def as_of_today(given: Sequence[str]) -> list[str]:
    """A command line with the words of today, for one that begins with a command of before."""
    words = list(given)
    if words[:1] == ["merge"]:
        _say("merge A B -o DEST", "copy A B --output DEST")
        return ["copy", *words[1:]]
    if words[:1] == ["repair"]:
        _say("repair", "verify --repair")
        rest = [word for word in words[1:] if word != "--verify"]
        # Without --verify it looked at seals and sizes.
        return ["verify", "--repair", *([] if "--verify" in words else ["--quick"]), *rest]
    return words


def _say(before: str, now: str) -> None:
    warnings.warn(Note(f"{before} is called {now} now."), stacklevel=3)
