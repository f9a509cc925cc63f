"""Comparing what a file says of itself with `limits.py`."""

from __future__ import annotations

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.limits import CLAIMED_BYTES, EXPANSION


class TooLarge(BadArgument):
    """A number in a file that is over its limit."""


def check_at_most(what: str, given: int, most: int, least: int = 0) -> None:
    """Raise `TooLarge` unless a number is in its range; `what` names it as the subject of the sentence.

    The sentence shows the number unless it has more digits than a person reads.
    """
    if not least <= given <= most:
        raise TooLarge(f"{what} is {_digits(given)}; expected {least} to {most:,}.")


def check_decoded(what: str, decoded: int, stored: int) -> None:
    """Raise `TooLarge` when an array or chunk says that its stored bytes hold more than such bytes can.

    A bomb of some kilobytes claims gigabytes; real numbers do not compress so well.
    """
    most = max(CLAIMED_BYTES, EXPANSION * stored)
    if decoded > most:
        raise TooLarge(
            f"{what} would take {_digits(decoded)} bytes of memory, from {stored:,} stored ones; expected at most "
            f"{most:,}"
        )


def _digits(number: int) -> str:
    return f"{number:,}" if abs(number) < 10**30 else "a number of more than 30 digits"
