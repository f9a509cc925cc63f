"""Ctrl-C and SIGTERM: one sentence and no traceback, whatever a program is doing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from tests.kit.http_ranges import serve
from tests.kit.stopped_programs import after_call, at_import, run_stopped
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.schemas.stop_signals import run_until_stopped, stops_kept_from_children
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.stores import StoreSpec, write_store

pytestmark = pytest.mark.usefixtures("usual_signals")

SENTENCE = "\nprogram: stopped; all is kept.\n"


def give(number: int = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


def run(command) -> int:
    return run_until_stopped("program", command, "all is kept.")


@pytest.mark.parametrize(
    ("number", "code", "sentence"),
    [(signal.SIGINT, 130, SENTENCE), (signal.SIGTERM, 143, "program: stopped by SIGTERM; all is kept.\n")],
)
def test_a_signal_is_one_sentence(capsys, number, code, sentence):
    assert run(lambda: give(number) or 0) == code
    assert capsys.readouterr().err == sentence


def test_what_a_library_makes_of_it_is_still_a_stop(capsys):
    def command() -> int:
        try:
            give()
        except KeyboardInterrupt:
            raise ImportError("initialisation failed") from None
        return 0

    assert run(command) == 130
    assert capsys.readouterr().err == SENTENCE


def test_an_error_without_a_signal_stays_an_error():
    with pytest.raises(ImportError):
        run(lambda: __import__("no_such_module"))


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
    assert capsys.readouterr().err == SENTENCE


class Interrupted:
    """Is interrupted in its destructor, where Python can pass on no exception."""

    def __del__(self) -> None:
        give()
        time.sleep(0)  # the handler runs at the next instruction


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_destructor_that_is_interrupted_loses_no_signal(capsys):
    waited = threading.Event()

    def command() -> int:
        thing = Interrupted()
        del thing
        waited.wait(60)
        return 0

    assert run(command) == 130
    assert capsys.readouterr().err == SENTENCE


def test_sigterm_is_left_to_whoever_handles_it(capsys):
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        assert run(lambda: give(signal.SIGTERM) or 5) == 5
    finally:
        signal.signal(signal.SIGTERM, before)
    assert came == [signal.SIGTERM]
    assert capsys.readouterr().err == ""


def test_afterwards_everything_is_as_before():
    def handlers() -> tuple:
        return signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), sys.unraisablehook

    before = handlers()
    assert run(lambda: 3) == 3
    assert run(lambda: give() or 0) == 130
    assert handlers() == before


def test_children_never_get_it():
    with stops_kept_from_children():
        code = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('not interrupted')"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "not interrupted\n"
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("elsewhere", [False, True], ids=["this thread", "another thread"])
def test_a_process_is_started_whole_before_a_stop(number, elsewhere, capsys):
    """One that is started in part prints a traceback of its own."""
    done, now = [], threading.Event()

    def give() -> None:
        if now.wait(60):
            signal.raise_signal(number)

    def start() -> int:
        with stops_kept_from_children():
            if elsewhere:
                now.set()
                thread.join()
            else:
                signal.raise_signal(number)
            done.append("started")
        done.append("went on")
        return 0

    thread = threading.Thread(target=give, daemon=True)  # not in the block, whose mask it would inherit
    thread.start()
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    assert run(start) == 128 + number
    assert done == ["started"]
    assert capsys.readouterr().err.count("\n") <= 2
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# ------------------------------------------------------------------------------------------- the programs themselves


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("stopped") / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=2, replans=2))


WORKERS = "vla_attention.analyze.stores.worker_processes"
SECOND = "vla_attention.analyze.stores.second_process"


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        (at_import("vla_attention.analyze.command_line"), []),
        (at_import("numpy"), []),
        (at_import("matplotlib"), ["--threads", "1"]),
        (after_call(WORKERS, "WorkerProcesses", "_submit"), ["--workers", "2"]),
        (after_call(SECOND, "SecondProcess", "__init__"), ["--threads", "2"]),
        (after_call("os", "", "replace"), ["--no-plots"]),
    ],
    ids=["start", "numpy", "pictures", "workers", "second process", "first file"],
)
def test_an_analysis_that_is_stopped_says_one_sentence(store, tmp_path, moment, words):
    given = [str(store), "--output", str(tmp_path / "out"), "--no-cache", *words]
    done = run_stopped("vla_attention.analyze", given, moment)
    assert done.stderr.strip() == "vla-analyze: stopped; nothing was left half written."
    assert done.returncode == 130
    assert not [file for file in tmp_path.rglob("*") if file.name.endswith(".partial")]


def test_an_analysis_that_gets_sigterm_says_one_sentence(store, tmp_path):
    given = [str(store), "--output", str(tmp_path / "out"), "--no-cache"]
    done = run_stopped("vla_attention.analyze", given, after_call("os", "", "replace"), "SIGTERM")
    assert done.stderr == "vla-analyze: stopped by SIGTERM; nothing was left half written.\n"
    assert done.returncode == 143
    assert not [file for file in tmp_path.rglob("*") if file.name.endswith(".partial")]


CAPTURE = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", "0", "--output", "STORE"]
STOPPED = "complete episodes are kept, continue with --resume."


@pytest.mark.parametrize(
    ("moment", "times"),
    [
        (at_import("vla_attention.capture.commands.command_line"), 1),
        (at_import("torch"), 1),
        (at_import("torch.nn"), 2),
        (after_call("vla_attention.capture.machine.device", "", "load_torch"), 1),
    ],
    ids=["start", "torch", "twice", "loading"],
)
def test_a_capture_that_is_stopped_says_one_sentence(tmp_path, moment, times):
    words = [str(tmp_path / "a.zarr") if word == "STORE" else word for word in CAPTURE]
    done = run_stopped("vla_attention.capture", words, moment, times=times)
    assert done.stderr.strip() == f"vla-capture: stopped; {STOPPED}"
    assert done.returncode == 130


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_command_that_records_nothing_speaks_of_no_episodes(name):
    done = run_stopped("vla_attention.capture", ["doctor", "--no-trial"], at_import("torch"), name)
    assert done.stderr.count("nothing was left half written.".capitalize() if name == "SIGTERM" else "nothing was") == 1
    assert "--resume" not in done.stderr


def test_a_capture_that_gets_sigterm_while_it_loads_says_one_sentence(tmp_path):
    words = [str(tmp_path / "a.zarr") if word == "STORE" else word for word in CAPTURE]
    done = run_stopped("vla_attention.capture", words, at_import("torch.nn"), "SIGTERM")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("vla-capture: stopped by SIGTERM. Complete episodes are kept")
    assert done.returncode == 75


@pytest.mark.parametrize("words", [("--list",), ("--no-plots", "--no-cache")], ids=["list", "masses"])
def test_a_server_that_sends_nothing_is_not_waited_for(store, tmp_path, words):
    pytest.importorskip("aiohttp", reason="needs the extra remote")
    copy_store(open_store(store), tmp_path / "served/a.zarr", (), packed=True)
    asked, ended = threading.Event(), threading.Event()

    def hang(path: str, content: bytes) -> bytes:
        if path.endswith(".zip"):
            asked.set()
            ended.wait(50)  # less than the client waits
        return content

    with serve(tmp_path / "served") as served:
        served.change = hang
        command = [sys.executable, "-m", "vla_attention.analyze", f"{served.url}/a.zarr", *words]
        program = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=tmp_path)
        try:
            assert asked.wait(60)
            program.send_signal(signal.SIGINT)
            said = program.communicate(timeout=40)[1]
        finally:
            ended.set()
            program.kill()
            program.wait()
    note, _, after = said.partition("\n")
    assert "lists every episode of it was not checked" in note
    assert (program.returncode, after) == (130, "\nvla-analyze: stopped; nothing was left half written.\n")
