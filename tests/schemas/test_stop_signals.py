"""Ctrl-C and SIGTERM: one sentence and no traceback, whatever a program is doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from tests.kit.stopped_programs import after_call, at_import, run_stopped
from tests.kit.stores import StoreSpec, write_store
from vla_attention.schemas.stop_signals import run_until_stopped, stops_kept_from_children

pytestmark = pytest.mark.usefixtures("usual_signals")


def give(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def run(command) -> int:
    return run_until_stopped("program", command, "all is kept.")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_with_its_code_and_one_line(capsys, number, code):
    assert run(lambda: give(number) or 0) == code
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("program: ")
    assert line.endswith("all is kept.")
    assert ("SIGTERM" in line) == (number == signal.SIGTERM)


def test_more_signals_while_it_cleans_up_change_nothing(capsys):
    cleaned = []

    def command() -> int:
        try:
            give()
        finally:
            try:
                give()
            finally:
                cleaned.append(True)
        return 0

    assert run(command) == 130
    assert cleaned
    assert capsys.readouterr().err.count("all is kept.") == 1


def test_children_never_get_it():
    with stops_kept_from_children():
        code = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('not interrupted')"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "not interrupted\n"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# ------------------------------------------------------------------------------------------- the programs themselves


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("stopped") / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=2, replans=2))


IN_A_POOL = ("concurrent.futures.process", "ProcessPoolExecutor", "submit")


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        (at_import("numpy"), []),
        pytest.param(after_call(*IN_A_POOL), ["--workers", "2"], marks=pytest.mark.thorough),
        (after_call("os", "", "replace"), ["--no-plots"]),
    ],
    ids=["numpy", "workers", "first file"],
)
def test_an_analysis_that_is_stopped_says_one_sentence(store, tmp_path, moment, words):
    given = [str(store), "--output", str(tmp_path / "out"), "--no-cache", *words]
    done = run_stopped("vla_attention.analyze", given, moment)
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.returncode == 130
    assert not [file for file in tmp_path.rglob("*") if file.name.endswith(".partial")]


def test_an_analysis_that_gets_sigterm_says_one_sentence(store, tmp_path):
    given = [str(store), "--output", str(tmp_path / "out"), "--no-cache"]
    done = run_stopped("vla_attention.analyze", given, after_call("os", "", "replace"), "SIGTERM")
    assert (done.stderr.count("\n"), "SIGTERM" in done.stderr) == (1, True)
    assert done.returncode == 143
    assert not [file for file in tmp_path.rglob("*") if file.name.endswith(".partial")]


CAPTURE = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", "0", "--output", "STORE"]


@pytest.mark.parametrize(
    ("moment", "times"),
    [
        pytest.param(at_import("torch.nn"), 2, marks=pytest.mark.thorough),
        (after_call("vla_attention.capture.machine", "", "load_torch"), 1),
    ],
    ids=["twice", "loading"],
)
def test_a_capture_that_is_stopped_says_one_sentence(tmp_path, moment, times):
    words = [str(tmp_path / "a.zarr") if word == "STORE" else word for word in CAPTURE]
    done = run_stopped("vla_attention.capture", words, moment, times=times)
    assert len(done.stderr.strip().splitlines()) == 1
    assert "--resume" in done.stderr
    assert done.returncode == 130


def test_a_capture_that_gets_sigterm_while_it_loads_says_one_sentence(tmp_path):
    words = [str(tmp_path / "a.zarr") if word == "STORE" else word for word in CAPTURE]
    done = run_stopped("vla_attention.capture", words, at_import("torch.nn"), "SIGTERM")
    assert done.stderr.count("\n") == 1
    assert "SIGTERM" in done.stderr
    assert done.returncode == 75
