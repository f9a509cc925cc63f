"""Which recording a budget chooses, and what it says; nothing is simulated."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_attention.capture.budget.budget import (
    BudgetTooSmall,
    Fixed,
    choose_recording,
    recordings_by_size,
)
from vla_attention.capture.store.disk_estimate import DiskEstimate
from vla_attention.schemas.stores.store_format import Recording

LAYERS, HEADS = tuple(range(18)), tuple(range(8))
PI = Recording(LAYERS, LAYERS, (0, 9), HEADS, "mean", 10, 10, contributions=True)


def bytes_of(recording: Recording) -> DiskEstimate:
    """A size that grows with what is recorded: a byte and a half for ten bits."""
    numbers = len(recording.layers) * len(recording.denoise_steps) * len(recording.heads) * 968
    return DiskEstimate(int(numbers * (7 + recording.mantissa_bits) / 8), 50, 500, episode_overhead=30_000)


@settings(max_examples=60, deadline=None)
@given(
    layers=st.integers(1, 30),
    heads=st.integers(1, 20),
    steps=st.integers(1, 12),
    fixed=st.builds(Fixed, *(st.booleans() for _ in range(4))),
)
def test_every_choice_is_a_recording_of_the_policy_and_smaller_than_the_one_before(layers, heads, steps, fixed) -> None:
    all_layers = tuple(range(layers))
    asked = Recording(
        all_layers, all_layers, tuple(sorted({0, steps - 1})), tuple(range(heads)), "mean", 10, 12, contributions=True
    )
    order = recordings_by_size(asked, steps, fixed)
    sizes = [bytes_of(recording).total_bytes for recording in order]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(order)) == len(order)
    for recording in order:
        assert set(recording.layers) <= set(asked.layers)
        assert recording.layers[-1] == layers - 1
        assert set(recording.heads) <= set(asked.heads)
        assert recording.heads
        assert max(recording.denoise_steps) == steps - 1
        assert recording.layer_labels == recording.layers
        for name in ("denoise_steps", "layers", "heads"):
            if getattr(fixed, name):
                assert getattr(recording, name) == getattr(asked, name)
        if fixed.precision:
            assert recording.mantissa_bits == 12


@given(budget=st.integers(1, 3 * 10**12))
def test_the_choice_is_the_first_that_fits(budget: int) -> None:
    order = recordings_by_size(PI, 10, Fixed())
    fitting = [recording for recording in order if bytes_of(recording).total_bytes <= budget]
    if not fitting:
        with pytest.raises(BudgetTooSmall, match=r"takes up to .* for 500 episodes; give at least that, --no-frames"):
            choose_recording(order, budget, bytes_of, 10)
        return
    choice = choose_recording(order, budget, bytes_of, 10)
    assert choice.recording == fitting[0]
    assert choice.estimate == bytes_of(fitting[0])
