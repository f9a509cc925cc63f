"""In which modules a policy computes attention, so that the rest of its functions need not be watched.

The first calls are watched throughout, until two in a row computed attention in no new module, and then every
sixteenth. In the others, a module is watched while it runs if it computed attention before, itself and not in a module
that it calls, or if it did not run before; and what comes of an attention call is watched, however far it goes. Calls
whose attention is changed are all watched throughout: one that is missed would change what the policy does.

Attention that begins in a module that had none is seen in the next call that is watched throughout. That is the next
one, after a call that did not fit its layout, or after more blocks without attention in a row than a queue of the
policy's explains.
"""

from __future__ import annotations

from collections.abc import Set

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
        missed: blocks since the last call that was watched throughout in which attention may have been missed.
    """

    def __init__(self) -> None:
        self.quiet: Set[int] = frozenset()
        self.seen: set[int] = set()
        self.calls = 0
        self.missed = 0
        self._attending: set[int] = set()
        self._settling = _SETTLING
        #: Blocks without attention in a row: now, and the most between two calls that were watched throughout.
        self._without = 0
        self._queue = 0

    def next_is_whole(self) -> bool:
        """Return whether the next call is watched throughout."""
        return self._settling > 0 or self.calls % EVERY == 0

    def doubt(self) -> None:
        """Watch the next call throughout."""
        self._settling = max(self._settling, 1)

    def passed(self, ran: Set[int], attending: Set[int], *, whole: bool, number: int) -> Set[int]:
        """Learn from a call; returns the modules by which it shows that attention was missed before.

        ran: ids of its modules. attending: of those that computed attention. whole: whether it was watched throughout.
        number: of its attention calls.
        """
        if not number:  # the policy answered from a queue, or computes attention where it did not
            self._without += 1
            if not whole and self._without > self._queue:
                self.missed += 1
                self.doubt()
            return frozenset()
        new = attending - self._attending
        found = new & self.quiet if self.missed else frozenset()
        if whole:
            self._settling, self.missed = (_SETTLING - 1 if new else max(self._settling - 1, 0)), 0
            self._queue = max(self._queue, self._without) if self.calls and not found else self._queue
        self._without = 0
        self.calls += 1
        self.seen |= ran
        self._attending |= attending
        self.quiet = frozenset() if OUTSIDE in self._attending else frozenset(self.seen - self._attending)
        return found
