"""Stage two as a separate process: the two stages share a store, not code."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from vla_attention.capture.policies.family import PolicyFamily


def run_analysis(arguments: argparse.Namespace, store: Path, output: Path | None, more: Sequence[str] = ()) -> int:
    """Analyse a store with the default arguments of its policy family; returns the exit code of `vla-analyze`.

    arguments: the parsed command line of the capture. more: further arguments for `vla-analyze`.
    """
    family: PolicyFamily = arguments.family
    command = [sys.executable, "-m", "vla_attention.analyze", str(store)]
    if output is not None:
        command += ["--output", str(output)]
    if arguments.save_viz:
        command += ["--save-viz"]
    process = subprocess.Popen([*command, *family.analysis_arguments(arguments), *more])
    try:
        return process.wait()
    except KeyboardInterrupt:
        # A terminal tells both processes, `kill` only this one. The analysis says that it was stopped.
        process.send_signal(signal.SIGINT)
        return process.wait()
    except BaseException:
        process.terminate()
        process.wait()
        raise
