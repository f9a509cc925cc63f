"""What the recorder gives to the store writer. Needs numpy only, so that a store can be written without torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class RecordedRows:
    """The rows of one site at one replan.

    rows: (layer, denoise, head, query, key) float32, the axes in the order of the plan.
    row_sum: (layer, denoise, head, query) float32, summed over keys in float64 from the rows as computed.
    contribution: (layer, denoise, part, part) float32, or None when contributions are not recorded. Entry (i, j) is the
        inner product of what parts i and j of the keys add to the residual stream, averaged over the action queries;
        the last part is the block's whole attention update.
    uniform: what uniform attention gives in the place of each row, (layer, denoise, head, query, key) float32, see
        `schemas/groupings/key_counts.py`; an axis along which nothing changes may have length 1. None: every query sees
        every key whose role is none of `UNSEEN_ROLES`.
    """

    rows: NDArray[np.float32]
    row_sum: NDArray[np.float32]
    contribution: NDArray[np.float32] | None = None
    uniform: NDArray[np.float32] | None = None
