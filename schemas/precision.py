"""How rows are stored: with k mantissa bits, up to ten of them as float16 of p x 2^15; and how far masses can be off.

All terms of a mass are non-negative. Rounding each of them to k mantissa bits (relative error <= 2^-(k+1), round to
nearest) therefore bounds the relative error of any mass by the same number, and that of any ratio of two masses by
about 2^-k, whatever the grouping.

Ten bits are what float16 holds, of p x 2^15 from p = 2^-29 on. Smaller probabilities are multiples of 2^-39, which adds
an absolute error of at most 2^-40 each:

    |error of a mass m of n keys| <= 2^-(k+1) m + n 2^-40
"""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Explicit mantissa bits of float32; keeping all of them is "exact".
FLOAT32_MANTISSA_BITS = 23
DEFAULT_MANTISSA_BITS = 10
#: Up to so many mantissa bits, rows are stored as float16.
HALF_MANTISSA_BITS = 10
#: A stored float16 times this is the probability: the attribute `scale_factor` of the rows, as the CF conventions have
#: it.
HALF_SCALE = 2.0**-15
#: Bits of the float16 of 1.99; no probability is larger. Above are infinities, NaN (what a missing chunk reads as) and
#: negative numbers.
_MOST_BITS = 0x7BF5


def parse_precision(text: str) -> int:
    """Read `--precision`: a number of mantissa bits 1..23, or `exact`. Returns the bits kept."""
    if text == "exact":
        return FLOAT32_MANTISSA_BITS
    if re.fullmatch(r"\d+", text) and 1 <= int(text) <= FLOAT32_MANTISSA_BITS:
        return int(text)
    raise BadArgument(
        f"Cannot use --precision '{text}'; expected mantissa bits from 1 to {FLOAT32_MANTISSA_BITS}, or 'exact'."
    )


def is_half(bits: int) -> bool:
    """Whether rows of so many mantissa bits are stored as float16."""
    return bits <= HALF_MANTISSA_BITS


def mass_error_bound(bits: int) -> float:
    """Largest relative error that rounding causes in any mass, but for `key_error_bound`."""
    return 0.0 if bits >= FLOAT32_MANTISSA_BITS else 2.0 ** -(bits + 1)


def key_error_bound(bits: int) -> float:
    """Largest error that each key of a group adds to the mass beside `mass_error_bound`: that of tiny probabilities."""
    return 2.0**-40 if is_half(bits) else 0.0


def to_stored(values: NDArray[np.float32], bits: int) -> NDArray[Any]:
    """Probabilities as they are stored: float16 of p x 2^15, or float32; rounded to `bits` mantissa bits.

    `values` must be finite, not negative and below 1.99; the shape is kept.
    """
    import numpy as np  # here, because a command line reads `--precision` without it

    if not is_half(bits):
        return round_mantissa(values, bits)
    scaled = np.asarray(values, np.float32) * np.float32(1 / HALF_SCALE) + np.float32(0)  # -0 becomes 0
    stored = (scaled if bits == HALF_MANTISSA_BITS else round_mantissa(scaled, bits)).astype("<f2")
    if not in_range(stored):
        raise ValueError("probabilities that are negative, above 1.99 or no numbers cannot be stored as float16")
    return stored


def in_range(stored: NDArray[np.float16]) -> bool:
    """Whether all float16 are finite, not negative, and those of probabilities below 1.99: one pass of integers."""
    return not stored.size or bool(stored.view("<u2").max() <= _MOST_BITS)


def from_half(stored: NDArray[np.float16], out: NDArray[np.float32] | None = None) -> NDArray[np.float32]:
    """The probabilities of stored float16 that are `in_range`, exactly; `out` has their shape.

    An integer shift puts exponent and mantissa where float32 has them, which is the number x 2^-112. numpy's own
    conversion takes ten times as long.
    """
    import numpy as np

    values = np.empty(stored.shape, np.float32) if out is None else out
    if _subnormals_are_zero():
        np.take(_table(), stored.view("<u2"), out=values, mode="clip")
        return values
    np.left_shift(stored.view("<u2"), 13, out=values.view(np.uint32), dtype=np.uint32, casting="unsafe")
    return np.multiply(values, np.float32(2.0**112 * HALF_SCALE), out=values)


def _subnormals_are_zero() -> bool:
    """Whether this thread takes subnormal float32 for 0, as libraries that were compiled for speed make it do."""
    import numpy as np

    smallest = np.array([1], np.uint32).view(np.float32)
    return not (smallest * np.float32(2.0**100))[0]


@cache
def _table() -> NDArray[np.float32]:
    """The probability of each of the 65,536 float16; numpy converts them without subnormal float32."""
    import numpy as np

    with np.errstate(invalid="ignore"):
        return np.arange(65536, dtype=np.uint16).view(np.float16).astype(np.float32) * np.float32(HALF_SCALE)


def as_read(values: NDArray[np.float32], bits: int) -> NDArray[np.float32]:
    """Probabilities as a store of that precision gives them back."""
    stored = to_stored(values, bits)
    return from_half(stored) if is_half(bits) else stored


def round_mantissa(values: NDArray[np.float32], bits: int) -> NDArray[np.float32]:
    """Round float32 values to `bits` mantissa bits, ties to even. Zeros and powers of two are kept exactly.

    `values` must be finite and non-negative (probabilities); the shape is kept.
    """
    import numpy as np

    if bits >= FLOAT32_MANTISSA_BITS:
        return values
    drop = FLOAT32_MANTISSA_BITS - bits
    raw = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    half = np.uint32((1 << (drop - 1)) - 1)
    odd = (raw >> np.uint32(drop)) & np.uint32(1)
    mask = np.uint32(0xFFFFFFFF ^ ((1 << drop) - 1))
    rounded: NDArray[np.float32] = ((raw + half + odd) & mask).view(np.float32)
    return rounded
