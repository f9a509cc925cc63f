"""What the commands of stage one share: SIGTERM and its exit code, places that cannot be written, and stage two as a process."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from vla_attention.capture.jobs.slurm import ask_for_requeue
from vla_attention.capture.jobs.termination import EXIT_TERMINATED, Terminated, Termination, listening_for_sigterm
from vla_attention.capture.jobs.worker import this_worker
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import BadArgument


def run_capture_command(program: str, command: Callable[[Termination], int], max_requeues: Callable[[], int]) -> int:
    """Run a command that captures; returns the exit code: 2 after a mistake, 130 after Ctrl-C, 75 after SIGTERM.

    After SIGTERM a SLURM job is put back into the queue, unless that has happened `max_requeues()` times (0: never).
    """
    # Set before MuJoCo is imported: GPU nodes and CI have no display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    with listening_for_sigterm() as termination:
        try:
            return run_command(
                program, lambda: command(termination), "complete episodes are kept, continue with --resume."
            )
        except Terminated:
            # Being requeued, SLURM sends it again.
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            said = ask_for_requeue(this_worker(), max_requeues()) if max_requeues() else ""
            said = said or "Complete episodes are kept; the same command with --resume goes on."
            print(f"{program}: stopped by SIGTERM. {said}", file=sys.stderr, flush=True)
            return EXIT_TERMINATED


def check_writable(path: Path, option: str) -> None:
    """Raise `BadArgument` when nothing can be made at `path`, before minutes are spent on loading a model. Makes nothing."""
    nearest = next(folder for folder in (path.absolute(), *path.absolute().parents) if folder.exists())
    if not nearest.is_dir():
        raise BadArgument(f"Cannot write to {path}: {nearest} is a file; give another {option}.")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise BadArgument(f"Cannot write to {path}: no permission to write in {nearest}; give another {option}.")


def run_analysis(arguments: argparse.Namespace, store: Path, output: Path | None, more: Sequence[str] = ()) -> int:
    """Run stage two as a process of its own (the two stages share a store, not code); returns its exit code."""
    command = [sys.executable, "-m", "vla_attention.analyze", str(store)]
    if output is not None:
        command += ["--output", str(output)]
    if arguments.save_viz:
        command += ["--save-viz"]
    if arguments.policy == "cosmos":
        # The published scripts' proxy: one latent frame's mass over another's, both of self-attention. Named by the frames,
        # because the denominator's default frame is a blank picture and holds no language.
        above, below = arguments.visual_frame, arguments.text_frame
        command += ["--site", "self", "--group", f"{above}=frame:{above}", "--group", f"{below}=frame:{below}"]
        command += ["--ratio", f"{above}/{below}", "--denoise", arguments.prefer_call]
    return subprocess.run([*command, *more], check=False).returncode
