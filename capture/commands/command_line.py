"""Running a capture command: SIGTERM and exit codes."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable

from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import MissingDependency, UserError
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.stop_signals import EXIT_TERMINATED, Terminated, Termination, listening_for_sigterm

#: Modules of the extra [capture] that are imported without a sentence of their own.
_OF_CAPTURE = ("torch", "safetensors", "sentencepiece")


class GpuMemoryFull(UserError, MemoryError):
    """The memory of the GPU does not suffice."""


def run_capture_command(
    program: str,
    parse: Callable[[], argparse.Namespace],
    if_stopped: str = "complete episodes are kept, continue with --resume.",
) -> int:
    """Run a command that captures; returns the exit code: 2 after a mistake, 130 after Ctrl-C, 75 after SIGTERM.

    parse: returns the arguments; their `command` is called with them. After SIGTERM a SLURM job is put back into the
    queue, at most `max_requeues` times where that is among them. if_stopped: what is kept and how to go on, for the
    sentence after either signal.
    """
    max_requeues = 0
    # Set before MuJoCo is imported, because GPU nodes and CI have no display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    with listening_for_sigterm() as termination:

        def command() -> int:
            nonlocal max_requeues
            arguments = parse()
            max_requeues = getattr(arguments, "max_requeues", 0)
            return int(arguments.command(arguments, termination))

        try:
            return run_command(program, lambda: _until_terminated(command, termination), if_stopped)
        except Terminated:
            # SLURM sends the signal again to a job that is being requeued.
            signal.signal(signal.SIGTERM, signal.SIG_IGN)

            from vla_attention.capture.jobs.slurm import ask_for_requeue
            from vla_attention.schemas.stores.worker import this_worker

            requeued = ask_for_requeue(this_worker(), max_requeues) if max_requeues else ""
            what_next = requeued or if_stopped[:1].upper() + if_stopped[1:]
            print(f"{program}: stopped by SIGTERM. {what_next}", file=sys.stderr, flush=True)
            return EXIT_TERMINATED


def _until_terminated(command: Callable[[], int], termination: Termination) -> int:
    try:
        return command()
    except UserError:
        raise
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name in _OF_CAPTURE:
            raise MissingDependency(
                f"{error.name} is not installed, and this command needs it: {install_line('capture')}."
            ) from error
        if termination.requested:  # a library made an error of its own out of the interruption
            raise Terminated from None
        if type(error).__name__ == "OutOfMemoryError":  # torch's, which is not imported for it
            raise GpuMemoryFull(
                "The memory of the GPU is full; use a smaller --policy-batch or --dtype bfloat16, or leave the GPU to "
                "this program alone. Complete episodes are kept, go on with --resume."
            ) from error
        raise
