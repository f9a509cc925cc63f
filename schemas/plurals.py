"""Numbers of things in messages: `1 episode`, `2 episodes`."""

from __future__ import annotations


def plural(count: int, noun: str) -> str:
    """`1 task`, `2 tasks`, `2 quantities`."""
    if count == 1:
        return f"1 {noun}"
    return f"{count} {noun[:-1]}ies" if noun.endswith("ty") else f"{count} {noun}s"
