"""A check of LIBERO's task files before its parser reads them.

The parser of hf-libero passes the angles of a region to Python's `eval`: a task file could execute anything.
"""

from __future__ import annotations

import re
from pathlib import Path

from vla_attention.capture.foreign_files.regular_files import check_regular
from vla_attention.schemas.errors import UserError

#: Bytes of a task file; LIBERO's have up to 3,300.
MAX_BYTES = 1_000_000
#: Parentheses in one another; LIBERO's have eight. Its parser compares and prints what it reads by recursion.
MAX_DEPTH = 64
#: The attribute that is evaluated. Nothing but numbers may stand beside it.
_EVALUATED = ":yaw_rotation"
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?")


class UnusableTask(UserError, ValueError):
    """A task's files in LIBERO, or its assets, make no scene."""


def check_task_file(path: Path) -> None:
    """Raise `UnusableTask` unless a task file is small, balanced, and evaluates numbers only."""
    try:
        size = check_regular(path, UnusableTask)
        if size > MAX_BYTES:
            raise UnusableTask(f"'{path}' has {size} bytes; a task file of {MAX_BYTES} at most is read.")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UnusableTask(f"There is no task file at '{path}'; install LIBERO again with 'make setup'.") from None
    except (OSError, UnicodeError) as error:
        raise UnusableTask(f"The task file '{path}' cannot be read ({error}).") from error
    # As the parser does it: comments, case, words.
    words = re.findall(r"[()]|[^\s()]+", re.sub(r";.*$", "", text, flags=re.MULTILINE).lower())
    # For each open parenthesis whether it, or one around it, has the attribute.
    evaluated = [False]
    for word in words:
        if word == "(":
            evaluated.append(evaluated[-1])
        elif word == ")":
            evaluated.pop()
        elif word == _EVALUATED:
            evaluated[-1] = True
        elif evaluated[-1] and not _NUMBER.fullmatch(word):
            raise UnusableTask(
                f"The task file '{path}' has '{word}' as an angle ({_EVALUATED}), which LIBERO would execute; expected "
                "numbers. Nothing of it was executed."
            )
        if not 1 <= len(evaluated) <= MAX_DEPTH:
            raise UnusableTask(f"The task file '{path}' has unbalanced parentheses, or more than {MAX_DEPTH} deep.")
