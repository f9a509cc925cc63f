"""A mark in the picture that says what an instruction would: which cube, and what to do with it.

Policies that are trained with it are a control: they need not read. Needs no simulator.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument, unknown_name

#: Verbs in the order of their places along the upper edge; the names are those of the suite's tasks.
MARK_VERBS = ("touch", "lift", "push_left", "push_right", "put_on")
#: Colours of the mark by the index of the cube: red, green, blue, yellow.
_MARK_RGB = ((230, 20, 20), (20, 200, 30), (20, 40, 230), (240, 220, 20))
#: The picture is cut into this many columns and rows; the mark takes one of the upper row.
_GRID = 8


def paste_mark(picture: NDArray[np.uint8], colour_index: int, verb_index: int) -> NDArray[np.uint8]:
    """Return a copy of a picture (height, width, 3), upright as the model sees it, with the mark in its upper edge.

    The mark is a square of an eighth of each side. Its colour is that of the cube `colour_index`; its place says the
    verb: column 1 for the first of `MARK_VERBS`, and so on. Columns 0, 6 and 7 stay empty.
    """
    height, width = picture.shape[:2]
    if height % _GRID or width % _GRID:
        raise BadArgument(f"A picture of {height} x {width} pixels is no whole number of {_GRID} x {_GRID} squares.")
    if not (0 <= colour_index < len(_MARK_RGB) and 0 <= verb_index < len(MARK_VERBS)):
        raise BadArgument(
            f"There is no mark for cube {colour_index} and verb {verb_index}; there are {len(_MARK_RGB)} cubes and "
            f"{len(MARK_VERBS)} verbs."
        )
    marked = picture.copy()
    side = width // _GRID
    left = (verb_index + 1) * side
    marked[: height // _GRID, left : left + side] = _MARK_RGB[colour_index]
    return marked


def verb_index(instruction: str) -> int:
    """Return the index in `MARK_VERBS` of what an instruction of the suite asks for."""
    words = instruction.split()
    verb = {"put": "put_on", "push": f"push_{words[-1]}"}.get(words[0], words[0]) if words else ""
    if verb not in MARK_VERBS:
        raise unknown_name("verb of the instruction", instruction, MARK_VERBS)
    return MARK_VERBS.index(verb)
