"""In which modules a policy computes attention, so that the rest of its functions need not be watched.

The first calls are watched throughout, until two in a row computed attention in no new module, and then every
sixteenth. In the others, a module is watched while it runs if it computed attention before, itself and not in a module
that it calls, or if it did not run before; and what comes of an attention call is watched, however far it goes.

Attention that begins in a module that had none is seen in the next call that is watched throughout: after a call in
which none was seen although other modules ran than in answers from a queue, that is the next one.
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any

#: Calls in a row without attention in a new module before only known ones are watched, with the first one.
_SETTLING = 3
#: Then one call in so many is watched throughout.
EVERY = 16
#: Stands for what a policy computes outside of its modules.
OUTSIDE = 0


class WatchedPlaces:
    """What the policy calls of one kind show: those that are recorded, or those that repeat them.

    Attributes:
        quiet: ids of modules that ran and computed no attention themselves; none where some was computed outside of
            all modules.
        seen: ids of all that ran.
        calls: number of calls with attention.
        missed: calls since the last one that was watched throughout in which attention may have been missed.
        facts: what is the same for all attention calls of one kind in a module, or for all softmaxes.
    """

    def __init__(self) -> None:
        self.quiet: Set[int] = frozenset()
        self.seen: set[int] = set()
        self.calls = 0
        self.missed = 0
        self.facts: dict[tuple[Any, ...], Any] = {}
        self._unlike: set[tuple[Any, ...]] = set()
        self._attending: set[int] = set()
        #: Modules that ran in calls without attention.
        self._idle: set[int] = set()
        self._settling = _SETTLING

    def next_is_whole(self) -> bool:
        """Return whether the next call is watched throughout."""
        return self._settling > 0 or self.calls % EVERY == 0

    def passed(self, ran: Set[int], attending: Set[int], *, whole: bool, number: int) -> Set[int]:
        """Learn from a call; returns the modules by which it shows that attention was missed before.

        ran: ids of its modules. attending: of those that computed attention. whole: whether it was watched throughout.
        number: of its attention calls.
        """
        if not number:  # the policy answered from a queue, or computes attention where it did not
            if whole:
                self._idle |= ran
            elif not ran <= self._idle:
                self._settling, self.missed = max(self._settling, 1), self.missed + 1
            return frozenset()
        new = attending - self._attending
        found = new & self.quiet if self.missed else frozenset()
        if whole:
            self._settling, self.missed = (_SETTLING - 1 if new else max(self._settling - 1, 0)), 0
        self.calls += 1
        self.seen |= ran
        self._attending |= attending
        self.quiet = frozenset() if OUTSIDE in self._attending else frozenset(self.seen - self._attending)
        return found

    def learn(self, key: tuple[Any, ...], facts: Any) -> None:
        """Keep what is known of the calls of one kind, unless it is not the same for all of them; None: it is not."""
        if key in self._unlike:
            return
        if facts is None or self.facts.setdefault(key, facts) != facts:
            self._unlike.add(key)
            self.facts.pop(key, None)
