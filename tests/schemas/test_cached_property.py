"""Values that are computed once for each object, and by several threads of different objects at once."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import pytest

from vla_attention.schemas.cached_property import cached_property


@dataclass(frozen=True)
class Counted:
    """Counts how often it computes."""

    calls: list[int] = field(default_factory=list)
    meeting: threading.Barrier | None = None

    @cached_property
    def value(self) -> int:
        """The value."""
        if self.meeting is not None:
            self.meeting.wait()
        self.calls.append(1)
        return len(self.calls)


def test_a_value_is_computed_once_and_goes_with_the_object():
    one, other = Counted(), Counted()
    assert (one.value, one.value, other.value) == (1, 1, 1)
    assert vars(one)["value"] == 1
    assert Counted.value.__doc__ == "The value."


def test_objects_do_not_wait_for_one_another():
    meeting = threading.Barrier(2, timeout=20)
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda one: one.value, [Counted(meeting=meeting), Counted(meeting=meeting)]))
    assert found == [1, 1]


def test_an_error_is_raised_again():
    class Failing:
        @cached_property
        def value(self) -> int:
            raise ValueError("no")

    failing = Failing()
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            _ = failing.value
