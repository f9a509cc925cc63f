"""Which recording a budget chooses, and what it says; nothing is simulated."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vla_attention.capture.budget.budget import (
    BudgetTooSmall,
    Fixed,
    choose_recording,
    parse_budget,
    recordings_by_size,
)
from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.run.run_settings import RunSettings, run_settings
from vla_attention.capture.store.disk_estimate import DiskEstimate
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import Recording

LAYERS, HEADS = tuple(range(18)), tuple(range(8))
PI = Recording(LAYERS, LAYERS, (0, 9), HEADS, "mean", 10, 10, contributions=True)


def bytes_of(recording: Recording) -> DiskEstimate:
    """A size that grows with what is recorded: a byte and a half for ten bits."""
    numbers = len(recording.layers) * len(recording.denoise_steps) * len(recording.heads) * 968
    return DiskEstimate(int(numbers * (7 + recording.mantissa_bits) / 8), 50, 500, episode_overhead=30_000)


def settings_of(*words: str) -> RunSettings:
    return run_settings(build_parser().parse_args(["pi", *words, "--output", "a.zarr"]))


@pytest.mark.parametrize(
    ("text", "expected"),
    [("20GB", 20e9), ("1.5tb", 1.5e12), ("500 MiB", 500 * 2**20), ("1000", 1000), ("2kB", 2000), (".5 GB", 5e8)],
)
def test_sizes_are_read(text: str, expected: float) -> None:
    assert parse_budget(text) == expected


@pytest.mark.parametrize("text", ["", "GB", "20 apples", "-1GB", "0", "0.1B", "1e9", "nanGB", "9" * 400 + "GB"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(BadArgument, match="expected a size such as 20GB"):
        parse_budget(text)


def test_the_order_is_the_documented_one() -> None:
    """All denoise steps first; then bits, steps, layers and heads are given up, in this order."""
    order = recordings_by_size(PI, 10, Fixed())
    described = [(len(r.denoise_steps), r.mantissa_bits, len(r.layers), len(r.heads)) for r in order]
    assert described == [
        *((10, 10, 18, 8), (10, 7, 18, 8), (6, 10, 18, 8), (6, 7, 18, 8), (3, 10, 18, 8), (3, 7, 18, 8)),
        *((2, 10, 18, 8), (2, 7, 18, 8), (2, 4, 18, 8), (1, 7, 18, 8), (1, 4, 18, 8)),
        *((1, 7, 9, 8), (1, 4, 9, 8), (1, 7, 6, 8), (1, 4, 6, 8), (1, 7, 3, 8), (1, 4, 3, 8), (1, 7, 2, 8)),
        *((1, 4, 2, 8), (1, 7, 2, 4), (1, 4, 2, 4), (1, 7, 2, 2), (1, 4, 2, 2), (1, 7, 2, 1), (1, 4, 2, 1)),
    ]
    assert order[2].denoise_steps == (0, 2, 4, 6, 8, 9)
    assert order[11].layers == order[11].layer_labels == (1, 3, 5, 7, 9, 11, 13, 15, 17)


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


def test_what_was_chosen_and_given_up_is_said() -> None:
    order = recordings_by_size(PI, 10, Fixed())
    one = bytes_of(order[11]).total_bytes
    said = choose_recording(order, one, bytes_of, 10).lines
    assert said[0].startswith("Budget 3.06 GB: recording denoise steps 9 of 0 to 9, 7 mantissa bits, layers 1, 3, 5, 7")
    assert "heads 0 to 7, which takes at most 3.06 GB" in said[0]
    assert said[1] == (
        "Given up for it: 9 of 10 denoise steps; 9 of 18 layers; 3 of 10 mantissa bits (a ratio is within 0.78 % of "
        "what was computed, instead of 0.098 %)."
    )
    assert said[2].startswith("The next larger recording, denoise steps 9 of 0 to 9, 4 mantissa bits, layers 0 to 17")
    everything = choose_recording(order, 10**15, bytes_of, 10).lines
    assert everything[1] == "Nothing was given up for it."
    assert "recording all 10 denoise steps, 10 mantissa bits, layers 0 to 17, heads 0 to 7" in everything[0]
    assert len(everything) == 2


def test_typed_options_stay_as_they_are() -> None:
    assert settings_of("--budget", "1GB").fixed == Fixed()
    words = ("--precision", "exact", "--denoise", "last", "--layers", "3", "--heads", "0", "1")
    typed = settings_of("--budget", "1GB", *words)
    assert typed.fixed == Fixed(precision=True, denoise_steps=True, layers=True, heads=True)
    assert typed.budget == 10**9
    asked = replace(PI, mantissa_bits=23, denoise_steps=(9,), layers=(3,), layer_labels=(21,), heads=(0, 1))
    assert recordings_by_size(asked, 10, typed.fixed) == (asked,)


def test_without_a_budget_the_defaults_are_what_they_were() -> None:
    plain = settings_of()
    assert plain.budget is None
    assert (plain.recording.denoise_steps, plain.recording.mantissa_bits) == (("first", "last"), 10)
    with pytest.raises(BadArgument, match="Cannot use --budget 'lots'"):
        settings_of("--budget", "lots")
