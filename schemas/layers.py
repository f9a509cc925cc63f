"""Layer numbers: block indices, and the recorded-call numbers of the published pi0 scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.errors import BadArgument, listing

#: Policy families whose published scripts number attention calls instead of blocks.
CALL_NUMBERED_FAMILIES = ("pi0", "pi05")


@dataclass(frozen=True)
class LayerSelection:
    """Blocks to use, and the number that the user typed for each. `note` is a line to print, when numbers were translated."""

    blocks: tuple[int, ...]
    labels: tuple[int, ...]
    note: str | None = None


def select_layers(numbers: Sequence[int] | None, num_layers: int, family: str) -> LayerSelection:
    """Translate `--layers` into block indices.

    The published pi0 scripts number attention *calls* of one inference: 0..n-1 are the prefix pass (without action queries), n..2n-1
    the first denoise step. Their numbers n..2n-1 are accepted for the families above, and mean block number - n.

    Raises `BadArgument` for any other number, or when two numbers mean the same block.
    """
    if numbers is None:
        return LayerSelection(tuple(range(num_layers)), tuple(range(num_layers)))
    accepts_call_numbers = family in CALL_NUMBERED_FAMILIES
    last = 2 * num_layers - 1 if accepts_call_numbers else num_layers - 1
    for number in numbers:
        if not 0 <= number <= last:
            also = f", or recorded-call numbers {num_layers} to {last}" if accepts_call_numbers else ""
            raise BadArgument(f"There is no layer {number}; expected block indices 0 to {num_layers - 1}{also}.")
    blocks = [number % num_layers for number in numbers]
    for block in blocks:
        same = [number for number, its in zip(numbers, blocks, strict=True) if its == block]
        if len(same) > 1:
            raise BadArgument(f"Layers {listing(same)} are the same block {block}; give each block once.")
    translated = [f"{number} = block {number - num_layers}" for number in numbers if number >= num_layers]
    note = (
        f"Layers {', '.join(translated)}: numbers from {num_layers} on are read as the published scripts' recorded-call numbers."
        if translated
        else None
    )
    return LayerSelection(tuple(blocks), tuple(numbers), note)
