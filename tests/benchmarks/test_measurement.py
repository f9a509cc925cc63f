"""`benchmarks/measurement.py`: turns, medians and the file of rows."""

from __future__ import annotations

import json
import sys
from itertools import count

import pytest

from benchmarks.measurement import Table, in_turn, measured, ratios, run_process, take_turns, write_rows


def test_every_round_calls_all_and_every_second_one_backwards():
    order = []
    found = in_turn({name: lambda name=name: order.append(name) or float(len(order)) for name in "abc"}, 2, warm_up=1)
    assert "".join(order) == "cbaabccba"
    assert found == {"a": [4.0, 9.0], "b": [5.0, 8.0], "c": [6.0, 7.0]}


def test_seconds_are_the_mean_of_the_repeats():
    ticks = count()
    calls = []
    found = take_turns({"a": lambda: calls.append(1)}, 3, repeats=4, warm_up=0, clock=lambda: float(next(ticks)))
    assert (len(calls), found) == (12, {"a": [0.25, 0.25, 0.25]})


def test_median_and_range_of_ratios_of_the_same_round():
    value = measured(ratios([2.0, 6.0, 3.0], [1.0, 2.0, 3.0]), factor=10)
    assert (value.median, value.lowest, value.highest, value.times) == (20, 10, 30, 3)


def test_rows_that_are_no_numbers_are_refused_and_the_file_stays(tmp_path):
    path = write_rows("x", {"one": Table({"s": "s"}, [{"s": 1.0}])}, folder=tmp_path)
    before = path.read_text()
    with pytest.raises(ValueError, match="JSON"):
        write_rows("x", {"one": Table({"s": "s"}, [{"s": float("nan")}])}, folder=tmp_path)
    assert path.read_text() == before
    json.loads(before)


def test_a_process_is_measured_and_a_failing_one_is_an_error():
    cost = run_process([sys.executable, "-c", "x = bytearray(60_000_000); x[::4096] = bytes(len(x[::4096]))"])
    assert cost.peak_mb > 60
    assert cost.seconds > 0
    here = bytearray(200_000_000)  # of the process that measures: it is no part of the peak of what it starts
    here[::4096] = bytes(len(here[::4096]))
    assert run_process([sys.executable, "-c", "pass"]).peak_mb < 60
    with pytest.raises(RuntimeError, match="so it fails"):
        run_process([sys.executable, "-c", "raise SystemExit('so it fails')"])
