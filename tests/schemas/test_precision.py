from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, mass_error_bound, parse_precision, round_mantissa

PROBABILITIES = hnp.arrays(
    np.float32, st.integers(1, 40), elements=st.floats(np.float32(1e-30), 1, width=32) | st.just(np.float32(0))
)


@given(values=PROBABILITIES, bits=st.integers(1, FLOAT32_MANTISSA_BITS))
def test_every_value_and_so_every_mass_is_within_the_bound(values, bits):
    rounded = round_mantissa(values, bits)
    assert rounded.dtype == np.float32
    error = np.abs(rounded.astype(float) - values.astype(float))
    assert (error <= mass_error_bound(bits) * values.astype(float)).all()
    assert abs(rounded.sum(dtype=float) - values.sum(dtype=float)) <= mass_error_bound(bits) * values.sum(dtype=float)
    assert ((rounded == 0) == (values == 0)).all()


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
    assert mass_error_bound(23) == 0
    assert mass_error_bound(10) == 2**-11
    for wrong in ("0", "24", "-1", "ten", "1.5"):
        with pytest.raises(BadArgument, match="1 to 23"):
            parse_precision(wrong)
