"""What a function does in the other process: its limits, its errors, its end."""

from __future__ import annotations

import mmap
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from vla_attention.schemas.bounded_process import BoundedProcess
from vla_attention.schemas.errors import BadArgument, UnknownName

FILE = Path("robot/a file")


def process_id() -> int:
    return os.getpid()


def take(count: int) -> np.ndarray:
    return np.ones(count, np.uint8)


def compute() -> None:
    while True:
        pass


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def raise_it(error: type[BaseException]) -> None:
    raise error("the sentence")


def last_byte(file: Path) -> int:
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        return mapped[-1]


def is_running(number: int) -> bool:
    return Path(f"/proc/{number}").exists()


def test_results_come_back_and_one_process_answers():
    process = BoundedProcess(BadArgument)
    assert process.call(FILE, take, 30_000_000).sum() == 30_000_000
    number = process.call(FILE, process_id)
    assert number != os.getpid()
    os.kill(number, signal.SIGTERM)  # what a job gets is for this process
    os.kill(number, signal.SIGINT)
    assert process.call(FILE, process_id) == number
    del process
    assert not is_running(number)


@pytest.mark.parametrize(
    ("function", "given", "how"),
    [
        (take, (10**10,), "memory"),
        (compute, (), "SIGXCPU"),
        (time.sleep, (1000,), " 3 s"),
        (crash, (), "SIGSEGV"),
    ],
)
def test_what_takes_too_much_is_refused_with_the_reason_and_the_next_file_is_read(function, given, how):
    process = BoundedProcess(BadArgument, processor_seconds=1, seconds=3 if function is time.sleep else 600)
    with pytest.raises(BadArgument, match=f"'robot/a file' .* 4 GB .*{how}"):
        process.call(FILE, function, *given)
    assert process.call(FILE, take, 3).tolist() == [1, 1, 1]


def test_a_file_is_tried_again_in_a_new_process_before_it_is_refused():
    process = BoundedProcess(BadArgument)
    first = process.call(FILE, process_id)
    with pytest.raises(BadArgument, match="SIGSEGV"):
        process.call(FILE, crash)
    assert process.call(FILE, process_id) != first


def test_a_file_that_is_larger_than_the_memory_may_be_mapped(tmp_path):
    file = tmp_path / "large"
    file.write_bytes(b"\7" * 200_000_000)
    assert BoundedProcess(BadArgument, most_bytes=100_000_000).call(file, last_byte, file) == 7
    os.truncate(file, 0)
    os.truncate(file, 200_000_000)  # a hole is no file
    with pytest.raises(RuntimeError):
        BoundedProcess(BadArgument, most_bytes=100_000_000).call(file, last_byte, file)


def test_errors_of_a_user_come_back_and_defects_have_their_traceback():
    process = BoundedProcess(BadArgument)
    with pytest.raises(UnknownName, match=r"^the sentence$"):
        process.call(FILE, raise_it, UnknownName)
    with pytest.raises(RuntimeError, match=r"in raise_it[\s\S]*ZeroDivisionError: the sentence"):
        process.call(FILE, raise_it, ZeroDivisionError)
    with pytest.raises(BadArgument, match=r"code 1\b"):  # as a panic of a library in Rust
        process.call(FILE, raise_it, BaseException)


def test_a_fork_has_a_process_of_its_own():
    process = BoundedProcess(BadArgument)
    number = process.call(FILE, process_id)
    child = os.fork()
    if not child:
        os._exit(int(process.call(FILE, process_id) == number))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert process.call(FILE, process_id) == number
