"""Working on several episodes at once changes nothing but the time."""

import threading
from functools import partial

import pytest

from vla_attention.analyze.stores.parallel import each_episode


def test_the_first_error_ends_it():
    begun = []
    gate = threading.Event()
    with pytest.raises(ValueError, match="episode 0"):
        list(each_episode(partial(_fail_first, begun=begun, gate=gate), range(1000)))
    assert len(begun) < 1000


def test_results_are_handed_out_one_by_one_and_few_episodes_are_begun_ahead():
    begun = []
    results = each_episode(partial(_begin, begun=begun), range(1000))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    results.close()
    assert len(begun) < 50


def _fail_first(i: int, begun: list[int], gate: threading.Event) -> int:
    begun.append(i)
    if i == 0:
        gate.set()
        raise ValueError("episode 0")
    gate.wait(10)
    return i


def _begin(i: int, begun: list[int]) -> int:
    begun.append(i)
    return i
