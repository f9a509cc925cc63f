"""Working on several episodes at once changes nothing but the time."""

import threading

import pytest

from vla_attention.analyze.stores.parallel import map_episodes


def test_results_come_in_order_and_progress_counts_each():
    counted = []
    assert map_episodes(lambda i: i * i, range(20), counted.append) == [i * i for i in range(20)]
    assert counted == [1] * 20


def test_the_first_error_ends_it():
    begun = []
    gate = threading.Event()

    def work(i: int) -> int:
        begun.append(i)
        if i == 0:
            gate.set()
            raise ValueError("episode 0")
        gate.wait(10)
        return i

    with pytest.raises(ValueError, match="episode 0"):
        map_episodes(work, range(1000))
    assert len(begun) < 1000
