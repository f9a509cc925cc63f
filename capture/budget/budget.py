"""`--budget 20GB`: the largest recording that fits into a number of bytes, and what was given up for it.

The order in which things are given up, and its reasons, are in docs/store.md ("A budget"). In short: first what costs
the least certainty (mantissa bits, whose error is far below that of the episodes), then denoise steps between the first
and the last, then the first, then layers between others, and heads last, because no head stands for another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from vla_attention.capture.store.disk_estimate import DiskEstimate
from vla_attention.schemas.byte_counts import parse_bytes
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, UserError, listing
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS, FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.store_format import Recording

#: Bits below the default that are tried: a ratio is within 0.8 % with 7 of them, and within 6 % with 4.
_FEWER_BITS, _FEWEST_BITS = 7, 4
#: Every how many layers, and every how many heads, are recorded where all are too many.
_LAYER_STRIDES = (2, 3, 6, 9)
_HEAD_STRIDES = (2, 4, 8)


class BudgetTooSmall(UserError, ValueError):
    """Not even the smallest recording fits into the budget."""


@dataclass(frozen=True)
class Fixed:
    """What the command line gives itself, and a budget therefore leaves as it is."""

    precision: bool = False
    denoise_steps: bool = False
    layers: bool = False
    heads: bool = False


@dataclass(frozen=True)
class Choice:
    """The recording that a budget allows, its size, and lines that say what was chosen and what was given up."""

    recording: Recording
    estimate: DiskEstimate
    lines: tuple[str, ...]


def parse_budget(text: str) -> int:
    """Read `--budget`: a number of bytes with a unit, such as 20GB, 1.5TB or 500 MiB."""
    size = parse_bytes(text)
    if not size:
        raise BadArgument(f"Cannot use --budget '{text}'; expected a size such as 20GB, 1.5TB or 500MiB.")
    return size


def recordings_by_size(asked: Recording, num_denoise_steps: int, fixed: Fixed) -> tuple[Recording, ...]:
    """Return the recordings that a budget chooses from, the largest first, each smaller than the one before.

    asked: what the command line asks for, with its defaults where it says nothing. num_denoise_steps: of the policy.
    """
    kept: list[Recording] = []
    for candidate in _in_order(asked, num_denoise_steps, fixed):
        if not kept or _cost(candidate) < _cost(kept[-1]):
            kept.append(candidate)
    return tuple(kept)


def choose_recording(
    candidates: Sequence[Recording],
    budget: int,
    estimate_of: Callable[[Recording], DiskEstimate],
    num_denoise_steps: int,
) -> Choice:
    """Return the first of the recordings, which get smaller, whose run takes at most `budget` bytes.

    estimate_of: gives a recording's size; called for a few of them only.

    Raises:
        BudgetTooSmall: the last one takes more.
    """
    low, high = 0, len(candidates)  # candidates[high:] fit
    estimates: dict[int, DiskEstimate] = {}
    while low < high:
        middle = (low + high) // 2
        estimates[middle] = estimate_of(candidates[middle])
        if estimates[middle].total_bytes <= budget:
            high = middle
        else:
            low = middle + 1
    if high == len(candidates):
        least, size = candidates[-1], estimates[len(candidates) - 1]
        raise BudgetTooSmall(
            f"Cannot keep within --budget {format_bytes(budget)}: the smallest recording "
            f"({_describe(least, num_denoise_steps)}) takes up to {format_bytes(size.total_bytes)} for "
            f"{size.num_episodes} episodes; give at least that{', --no-frames' if least.frames else ''}, or fewer "
            "episodes or steps."
        )
    chosen, size = candidates[high], estimates[high]
    lines = [
        f"Budget {format_bytes(budget)}: recording {_describe(chosen, num_denoise_steps)}, which takes at most "
        f"{format_bytes(size.total_bytes)}."
    ]
    lost = list(_given_up(candidates[0], chosen))
    lines.append(f"Given up for it: {'; '.join(lost)}." if lost else "Nothing was given up for it.")
    if high:
        above = candidates[high - 1]
        wanted = estimates.get(high - 1) or estimate_of(above)
        lines.append(
            f"The next larger recording, {_describe(above, num_denoise_steps)}, takes up to "
            f"{format_bytes(wanted.total_bytes)}."
        )
    return Choice(chosen, size, tuple(lines))


def _in_order(asked: Recording, num_denoise_steps: int, fixed: Fixed) -> Iterator[Recording]:
    """Yield recordings in the order in which things are given up; some are not smaller than the one before."""
    default, fewer, fewest = (
        (asked.mantissa_bits,) * 3 if fixed.precision else (DEFAULT_MANTISSA_BITS, _FEWER_BITS, _FEWEST_BITS)
    )
    steps = [asked.denoise_steps] if fixed.denoise_steps else _fewer_steps(num_denoise_steps)
    layers = [asked.layers] if fixed.layers else [asked.layers, *_thinned(asked.layers, _LAYER_STRIDES)]
    heads = [asked.heads] if fixed.heads else [asked.heads, *_thinned(asked.heads, _HEAD_STRIDES)]

    def recording(bits: int, step: int, layer: int = 0, head: int = 0) -> Recording:
        chosen = layers[layer]
        # Labels may be the published scripts' numbers, of which a block can have two.
        labels = asked.layer_labels if chosen == asked.layers else chosen
        return replace(
            asked,
            mantissa_bits=bits,
            denoise_steps=steps[step],
            layers=chosen,
            layer_labels=labels,
            heads=heads[head],
        )

    few = max(0, len(steps) - 2)  # the first and the last step, where both may go
    for step in range(few + 1):
        yield recording(default, step)
        yield recording(fewer, step)
    yield recording(fewest, few)
    for bits in (fewer, fewest):
        yield recording(bits, -1)
    for layer in range(1, len(layers)):
        for bits in (fewer, fewest):
            yield recording(bits, -1, layer)
    for head in range(1, len(heads)):
        for bits in (fewer, fewest):
            yield recording(bits, -1, -1, head)


def _fewer_steps(count: int) -> list[tuple[int, ...]]:
    """All denoise steps, every second with the last, first with middle and last, first and last, the last."""
    last = count - 1
    choices = [range(count), (*range(0, last, 2), last), (0, count // 2, last), (0, last), (last,)]
    return list(dict.fromkeys(tuple(sorted(set(choice))) for choice in choices))


def _thinned(numbers: Sequence[int], strides: Iterable[int]) -> list[tuple[int, ...]]:
    """Every second, third ... of the numbers, counted from the last one, while at least one is left out."""
    thinned = (tuple(numbers[::-1][::stride][::-1]) for stride in strides)
    return list(dict.fromkeys(chosen for chosen in thinned if len(chosen) < len(numbers)))


def _cost(recording: Recording) -> float:
    """Something that grows with the bytes of the rows: how many there are, times the bits of each."""
    # 7 bits of exponent are stored in any case, see `disk_estimate.bytes_per_number`.
    return len(recording.denoise_steps) * len(recording.layers) * len(recording.heads) * (7 + recording.mantissa_bits)


def _describe(recording: Recording, num_denoise_steps: int) -> str:
    bits = recording.mantissa_bits
    precision = "exact" if bits == FLOAT32_MANTISSA_BITS else f"{bits} mantissa bits"
    steps = (
        f"all {num_denoise_steps} denoise steps"
        if len(recording.denoise_steps) == num_denoise_steps
        else f"denoise steps {listing(recording.denoise_steps, 40)} of 0 to {num_denoise_steps - 1}"
    )
    return f"{steps}, {precision}, layers {_numbers(recording.layers)}, heads {_numbers(recording.heads)}"


def _numbers(numbers: Sequence[int]) -> str:
    """Return numbers for a sentence: `0 to 17`, or all of them."""
    if len(numbers) > 2 and numbers == tuple(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]} to {numbers[-1]}"
    return listing(numbers, 40)


def _given_up(full: Recording, chosen: Recording) -> Iterator[str]:
    for what, before, after in (
        ("denoise steps", full.denoise_steps, chosen.denoise_steps),
        ("layers", full.layers, chosen.layers),
        ("heads", full.heads, chosen.heads),
    ):
        if len(after) < len(before):
            yield f"{len(before) - len(after)} of {len(before)} {what}"
    bits, most = chosen.mantissa_bits, full.mantissa_bits
    if bits < most:
        yield (
            f"{most - bits} of {most} mantissa bits (a ratio is within {100 * 2.0**-bits:.2g} % of what was computed, "
            f"instead of {100 * 2.0**-most:.2g} %)"
        )
