"""The analysis after a capture, stopped by Ctrl-C or SIGTERM: it is told, and nothing of it is left running."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from vla_attention.capture.commands.command_line import run_capture_command
from vla_attention.capture.run import command
from vla_attention.capture.run.command import run_analysis

pytestmark = pytest.mark.usefixtures("usual_signals")

_ANALYSIS = """#!/bin/sh
echo $$ > {folder}/process
trap 'echo "vla-analyze: stopped; nothing was left half written." >&2; exit 130' INT
trap 'exit 143' TERM
touch {folder}/ready
while true; do sleep 0.05; done
"""


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, ["vla-analyze: stopped; nothing was left half written."]),
        (signal.SIGTERM, 75, ["vla-capture: stopped by SIGTERM. Complete episodes are kept, continue with --resume."]),
    ],
)
def test_a_stopped_analysis_says_it_once(tmp_path, monkeypatch, capfd, number, code, said):
    program = tmp_path / "analysis"
    program.write_text(_ANALYSIS.format(folder=tmp_path))
    program.chmod(0o700)
    monkeypatch.setattr(command, "sys", SimpleNamespace(executable=str(program)))
    arguments = SimpleNamespace(family=SimpleNamespace(analysis_arguments=lambda given: []), save_viz=False)

    waits = threading.Event()

    def waiting(process: subprocess.Popen, timeout: float | None = None) -> int:
        """Wait in short steps: a signal right before one long wait would be handled only after it."""
        waits.set()
        while process.poll() is None:
            time.sleep(0.01)
        return process.returncode

    monkeypatch.setattr(subprocess.Popen, "wait", waiting)

    def stop_when_it_runs() -> None:
        assert waits.wait(60)
        while not (tmp_path / "ready").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    stopper = threading.Thread(target=stop_when_it_runs)
    stopper.start()
    assert (
        run_capture_command("vla-capture", lambda _: run_analysis(arguments, Path("a.zarr"), None), lambda: 0) == code
    )
    stopper.join()
    lines = capfd.readouterr().err.strip().splitlines()
    assert [line.startswith(begin) for line, begin in zip(lines, said, strict=True)] == [True]
    assert not Path(f"/proc/{(tmp_path / 'process').read_text().strip()}").exists()
