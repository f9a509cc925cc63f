"""Where a policy computes attention, so that the rest of its functions need not be watched.

A place is the beginning or the end of a module's call: it stands for all that the policy computes until the next one.
Attention is looked for behind every place in the first calls, until two in a row computed it behind no new place, and
then in every sixteenth. In the others nothing is watched behind places that were passed and had none; a module that did
not run before is watched, and so is what comes of an attention call, however far it goes.
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any

#: Calls in a row without attention behind a new place before only known places are watched, with the first one.
_SETTLING = 3
#: Then one call in so many is watched throughout.
EVERY = 16


class WatchedPlaces:
    """What the policy calls of one kind show: those that are recorded, or those that repeat them.

    Attributes:
        quiet: places with no attention behind them: ids of modules, which stand for their beginning, and negative ids
            for their end; 0 is the beginning of the call.
        seen: all that were passed.
        calls: number of calls with attention.
        facts: what is the same for all attention calls of one kind behind a place, or for all softmaxes.
    """

    def __init__(self) -> None:
        self.quiet: set[int] = set()
        self.seen: set[int] = set()
        self.facts: dict[tuple[Any, ...], Any] = {}
        self._unlike: set[tuple[Any, ...]] = set()
        self._attending: set[int | None] = set()
        self._settling = _SETTLING
        self.calls = 0

    def next_is_whole(self) -> bool:
        """Return whether the next call is watched throughout."""
        return self._settling > 0 or self.calls % EVERY == 0

    def passed(self, places: Set[int], attending: Set[int | None]) -> None:
        """Learn from a call which places it passed, and behind which it computed attention (None: of other modules)."""
        if not attending:
            return  # the policy answered from a queue
        new = not attending <= self._attending
        self.calls += 1
        self._settling = _SETTLING - 1 if new else max(self._settling - 1, 0)
        self.seen |= places
        self._attending |= attending
        self.quiet = self.seen - self._attending

    def learn(self, key: tuple[Any, ...], facts: Any) -> None:
        """Keep what is known of the calls of one kind, unless it is not the same for all of them."""
        if key in self._unlike:
            return
        if facts is None or self.facts.setdefault(key, facts) != facts:
            self._unlike.add(key)
            self.facts.pop(key, None)
