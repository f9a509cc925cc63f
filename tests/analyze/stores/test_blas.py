"""A scan computes matrix products with one thread, and leaves the process as it was."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from vla_attention.analyze.stores.blas import _thread_functions, one_blas_thread
from vla_attention.analyze.stores.parallel import map_episodes


@pytest.fixture
def count():
    """The library's own number of threads, which is 3 during the test."""
    functions = _thread_functions()
    if functions is None:
        pytest.skip("numpy's BLAS here has no call for its number of threads")
    get, limit = functions
    before = get()
    limit(3)
    assert get() == 3
    yield get
    limit(before)


def _called(count: Callable[[], int], _: int) -> int:
    return count()


def _fail(_: int) -> None:
    raise ValueError("damaged")


def test_the_blas_of_numpys_wheels_can_be_limited():
    built = np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]
    if "openblas" not in built:
        pytest.skip(f"numpy is built with {built}")
    assert _thread_functions() is not None


def test_a_scan_has_one_thread_inside_and_the_users_number_after_it(count):
    assert map_episodes(partial(_called, count), range(5)) == [1] * 5
    assert count() == 3


def test_an_error_in_a_scan_gives_the_number_back(count):
    with pytest.raises(ValueError, match="damaged"):
        map_episodes(_fail, range(3))
    assert count() == 3


def test_the_python_api_limits_and_restores(count, monkeypatch, tmp_path):
    import vla_attention as va
    from vla_attention.analyze.measures import steps
    from vla_attention.testing.stores import write_store

    inside = []
    real = steps.masses

    def watched(*arguments, **options):
        inside.append(count())
        return real(*arguments, **options)

    monkeypatch.setattr(steps, "masses", watched)
    va.open(write_store(tmp_path / "a.zarr")).ratios(groups={"bowl": "word:bowl", "rest": "*"})
    assert inside
    assert set(inside) == {1}
    assert count() == 3


def test_scans_that_overlap_give_the_number_back_once(count):
    entered, leave = threading.Event(), threading.Event()

    def other() -> None:
        with one_blas_thread():
            entered.set()
            leave.wait(30)

    thread = threading.Thread(target=other)
    thread.start()
    assert entered.wait(30)
    with one_blas_thread():
        assert count() == 1
    assert count() == 1  # the other scan still runs
    leave.set()
    thread.join()
    assert count() == 3
