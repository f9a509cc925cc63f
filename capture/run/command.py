"""`vla-attention capture FAMILY`: record a policy into a store, and analyse the store on request."""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.threads import Threads, use_threads

if TYPE_CHECKING:
    from vla_attention.capture.policies.policy import Policy
    from vla_attention.capture.run.run_settings import RunSettings


def run_capture_of_family(arguments: argparse.Namespace, termination: Termination) -> int:
    """Run `vla-attention capture FAMILY` on parsed arguments; returns the exit code."""
    threads = use_threads(arguments.threads)

    from vla_attention.capture.run.run_settings import run_settings
    from vla_attention.capture.store.store_writer import check_target
    from vla_attention.schemas.stores.store_place import check_writable

    settings = run_settings(arguments)
    # An existing store or an unwritable place is an error now, before the minutes for loading a model.
    check_target(settings.store, settings.output.mode)
    if arguments.output_dir is not None:
        check_writable(arguments.output_dir, "--output-dir")
    policy, device = load_policy(arguments, [settings], threads)

    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.run.capture_run import run_capture

    run_capture(settings, policy, device, termination)
    if arguments.output_dir is None and not arguments.save_viz:
        question = "analyze" if settings.most_rollouts is None else "language"
        say(f"Next: vla-attention {question} {settings.store}")
        return 0
    return run_analysis(arguments, settings.store, arguments.output_dir)


def load_policy(arguments: argparse.Namespace, runs: Sequence[RunSettings], threads: Threads) -> tuple[Policy, str]:
    """Build the policy of runs in one kind of simulator; returns it and its device.

    A simulator that cannot run, and an instruction that the policy has no encoding of, are errors before the model is
    loaded.
    """
    from vla_attention.capture.environments.drawing import check_simulator

    check_simulator(runs[0].suite, runs[0].libero_assets)

    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.machine import load_torch

    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    arguments.instructions = [told for settings in runs for told in settings.instructions()]
    family: PolicyFamily = arguments.family
    return family.read(arguments).build(device), device


def run_analysis(arguments: argparse.Namespace, store: Path, output: Path | None, more: Sequence[str] = ()) -> int:
    """Analyse a store with the default arguments of its policy family; returns the exit code of `analyze`.

    It is a process of its own: the two stages share a store, not code.

    arguments: the parsed command line of the capture. more: further arguments for `analyze`.
    """
    family: PolicyFamily = arguments.family
    command = [sys.executable, "-m", "vla_attention.analyze", str(store)]
    if output is not None:
        command += ["--output", str(output)]
    if arguments.save_viz:
        command += ["--save-viz"]
    process = subprocess.Popen([*command, *family.read(arguments).analysis_arguments(), *more])
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
