"""Layer numbers: block indices, and the recorded-call numbers of the published pi0 scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vla_attention.schemas.errors import BadArgument, listing

#: Policy families whose published scripts number attention calls instead of blocks.
CALL_NUMBERED_FAMILIES = ("pi0", "pi05")


@dataclass(frozen=True)
class LayerSelection:
    """Blocks to use, and the number that the user typed for each; `note`: printed if numbers were translated."""

    blocks: tuple[int, ...]
    labels: tuple[int, ...]
    note: str | None = None


def select_layers(numbers: Sequence[int] | None, num_layers: int, family: str) -> LayerSelection:
    """Translate `--layers` into block indices.

    The published pi0 scripts number the attention *calls* of one inference: 0..n-1 are the prefix pass (without action
    queries), n..2n-1 the first denoise step. Their numbers n..2n-1 are accepted for the families above; number i means
    block i - n.

    A block may be given both ways (the published example `0 8 17 25 26 27` has block 8 twice): results then have both
    numbers. Raises `BadArgument` for any other number, and for the same number twice.
    """
    if numbers is None:
        return LayerSelection(tuple(range(num_layers)), tuple(range(num_layers)))
    accepts_call_numbers = family in CALL_NUMBERED_FAMILIES
    last = 2 * num_layers - 1 if accepts_call_numbers else num_layers - 1
    for number in numbers:
        if not 0 <= number <= last:
            also = f", or recorded-call numbers {num_layers} to {last}" if accepts_call_numbers else ""
            raise BadArgument(f"There is no layer {number}; expected block indices 0 to {num_layers - 1}{also}.")
    if accepts_call_numbers and _runs_across(numbers, num_layers):
        raise BadArgument(
            f"Layers {num_layers - 1} and {num_layers} do not follow each other: {num_layers - 1} is the last block, "
            f"and {num_layers} the published scripts' number of block 0. A range stays on one side: "
            f"0-{num_layers - 1}, or {num_layers}-{last}."
        )
    if len(set(numbers)) != len(numbers):
        raise BadArgument(f"Layers {listing(numbers, 40)} name one of them twice; give each number once.")
    return LayerSelection(block_of_labels(numbers, num_layers), tuple(numbers), _translation_note(numbers, num_layers))


def _runs_across(numbers: Sequence[int], num_layers: int) -> bool:
    """Whether three numbers in a row, as of a range, lie on both sides of the first call number."""
    threes = zip(numbers, numbers[1:], numbers[2:], strict=False)
    return any((a + 1, b + 1) == (b, c) and a < num_layers <= c for a, b, c in threes)


def block_of_labels(numbers: Sequence[int], num_layers: int) -> tuple[int, ...]:
    """The block of each layer number that `select_layers` has accepted."""
    return tuple(number % num_layers for number in numbers)


def _translation_note(numbers: Sequence[int], num_layers: int) -> str | None:
    calls = [number for number in numbers if number >= num_layers]
    if not calls:
        return None
    translated = ", ".join(f"{number} = block {number - num_layers}" for number in calls)
    note = (
        f"Layers {translated}: numbers from {num_layers} on are read as the published scripts' recorded-call numbers, "
        "which are of the first denoise step."
    )
    twice = [number for number in calls if number - num_layers in numbers]
    if twice:
        pairs = listing([f"{number - num_layers} and {number}" for number in twice])
        note += f" {pairs} are the same block, and count once in layers_avg."
    return note
