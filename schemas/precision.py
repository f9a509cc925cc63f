"""Mantissa rounding of the stored rows, and the bound that it puts on the error of every grouping's masses.

All terms of a mass are non-negative. Rounding each of them to k mantissa bits (relative error <= 2^-(k+1), round to
nearest) therefore bounds the relative error of any mass by the same number, and that of any ratio of two masses by
about 2^-k, whatever the grouping.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Explicit mantissa bits of float32; keeping all of them is "exact".
FLOAT32_MANTISSA_BITS = 23
DEFAULT_MANTISSA_BITS = 10


def parse_precision(text: str) -> int:
    """Read `--precision`: a number of mantissa bits 1..23, or `exact`. Returns the bits kept."""
    if text == "exact":
        return FLOAT32_MANTISSA_BITS
    if re.fullmatch(r"\d+", text) and 1 <= int(text) <= FLOAT32_MANTISSA_BITS:
        return int(text)
    raise BadArgument(
        f"Cannot use --precision '{text}'; expected mantissa bits from 1 to {FLOAT32_MANTISSA_BITS}, or 'exact'."
    )


def round_mantissa(values: NDArray[np.float32], bits: int) -> NDArray[np.float32]:
    """Round float32 values to `bits` mantissa bits, ties to even. Zeros and powers of two are kept exactly.

    `values` must be finite and non-negative (probabilities); the shape is kept.
    """
    import numpy as np  # here, because a command line reads `--precision` without it

    if bits >= FLOAT32_MANTISSA_BITS:
        return values
    drop = FLOAT32_MANTISSA_BITS - bits
    raw = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    half = np.uint32((1 << (drop - 1)) - 1)
    odd = (raw >> np.uint32(drop)) & np.uint32(1)
    mask = np.uint32(0xFFFFFFFF ^ ((1 << drop) - 1))
    rounded: NDArray[np.float32] = ((raw + half + odd) & mask).view(np.float32)
    return rounded


def mass_error_bound(bits: int) -> float:
    """Largest relative error that rounding causes in any mass."""
    return 0.0 if bits >= FLOAT32_MANTISSA_BITS else 2.0 ** -(bits + 1)
