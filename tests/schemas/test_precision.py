from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.precision import (
    FLOAT32_MANTISSA_BITS,
    HALF_MANTISSA_BITS,
    as_read,
    from_half,
    in_range,
    key_error_bound,
    mass_error_bound,
    parse_precision,
    round_mantissa,
    to_stored,
)

#: From sizes that float16 of p x 2^15 keeps to those that it does not know.
SIZES = st.floats(-45, 0).map(lambda exponent: np.float32(2.0**exponent))
PROBABILITIES = hnp.arrays(
    np.float32,
    st.integers(1, 40),
    elements=SIZES | st.floats(np.float32(1e-30), 1, width=32) | st.just(np.float32(0)),
)
EVERY_HALF = np.arange(65536, dtype=np.uint16).view(np.float16)


@given(values=PROBABILITIES, bits=st.integers(1, FLOAT32_MANTISSA_BITS))
def test_every_value_and_so_every_mass_is_within_the_bound(values, bits):
    read, exact = as_read(values, bits), values.astype(float)
    assert read.dtype == np.float32
    assert (np.abs(read - exact) <= mass_error_bound(bits) * exact + key_error_bound(bits)).all()
    mass, keys = exact.sum(), len(values)
    assert abs(read.sum(dtype=float) - mass) <= mass_error_bound(bits) * mass + keys * key_error_bound(bits)
    large = values >= 2.0**-29
    assert (np.abs(read - exact) <= mass_error_bound(bits) * exact)[large].all()
    assert np.array_equal(read[large], round_mantissa(values, bits)[large])
    assert (read[values == 0] == 0).all()


@given(values=PROBABILITIES, bits=st.integers(1, FLOAT32_MANTISSA_BITS))
def test_rounding_drops_the_bits_is_idempotent_and_keeps_order(values, bits):
    rounded = round_mantissa(values, bits)
    dropped = FLOAT32_MANTISSA_BITS - bits
    assert not (rounded.view(np.uint32) & np.uint32((1 << dropped) - 1)).any()
    assert np.array_equal(round_mantissa(rounded, bits), rounded)
    assert (np.diff(round_mantissa(np.sort(values), bits)) >= 0).all()


def test_ties_go_to_the_even_neighbour():
    # With 2 bits, 1.125 lies between 1.0 (even) and 1.25; 1.375 between 1.25 and 1.5 (even).
    assert round_mantissa(np.array([1.125, 1.375], dtype=np.float32), 2).tolist() == [1.0, 1.5]


def test_precision_of_the_command_line():
    assert parse_precision("exact") == 23
    assert parse_precision("10") == 10
    assert mass_error_bound(23) == key_error_bound(23) == key_error_bound(11) == 0
    assert mass_error_bound(10) == 2**-11
    assert key_error_bound(10) == 2**-40
    for wrong in ("0", "24", "-1", "ten", "1.5"):
        with pytest.raises(BadArgument, match="1 to 23"):
            parse_precision(wrong)


def test_every_stored_float16_is_read_as_it_is():
    known = EVERY_HALF[[in_range(one) for one in EVERY_HALF[:, None]]]
    assert len(known) == 0x7BF6
    assert np.array_equal(from_half(known), known.astype(np.float64) * 2.0**-15)
    pairs = np.stack([known, known])[:, ::2]  # neither in one piece, nor of one axis
    assert np.array_equal(from_half(pairs), pairs.astype(np.float64) * 2.0**-15)


def test_what_is_no_probability_is_not_stored_and_not_in_range():
    """NaN, the fill value of a missing chunk, would read as 3, infinity as 2."""
    refused = [value for value in EVERY_HALF if not in_range(np.array([value]))]
    with np.errstate(invalid="ignore"):
        numbers = np.array(refused, float) * 2.0**-15
    assert (np.isnan(numbers) | (numbers > 1.989) | np.signbit(numbers)).all()
    for value in (np.nan, np.inf, 1.99, 2.0, -1e-9, 1e38):
        with np.errstate(over="ignore"), pytest.raises(ValueError, match="above 1"):
            to_stored(np.array([0.5, value], np.float32), HALF_MANTISSA_BITS)
    stored = to_stored(np.array([1, 1.989, -0.0], np.float32), HALF_MANTISSA_BITS)
    assert stored.dtype == np.float16
    assert not np.signbit(stored).any()


def test_tiny_probabilities_are_read_where_subnormal_numbers_are_taken_for_zero():
    """Half of them below 2^-29. Libraries that were compiled for speed set this for their threads, as torch can."""
    torch = pytest.importorskip("torch")
    values = np.float32(2.0) ** np.random.default_rng(0).uniform(-39, -1, 4000).astype(np.float32)
    values[::2] = np.float32(2.0) ** np.random.default_rng(1).uniform(-39, -29, 2000).astype(np.float32)
    stored = to_stored(values, HALF_MANTISSA_BITS)
    expected = from_half(stored)
    assert torch.set_flush_denormal(True)
    try:
        assert (np.array([1], np.uint32).view(np.float32) * np.float32(2.0**100))[0] == 0
        found, written = from_half(stored), to_stored(values, HALF_MANTISSA_BITS)
    finally:
        torch.set_flush_denormal(False)
    assert np.array_equal(found, expected)
    assert np.array_equal(written, stored)
    assert (expected > 0).all()
