"""`vla-capture FAMILY`: record a policy into a store, and analyse the store on request."""

from __future__ import annotations

import argparse

from vla_attention.capture.analysis_process import run_analysis
from vla_attention.capture.command_line import check_writable
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.threads import use_threads


def run_capture_of_family(arguments: argparse.Namespace, termination: Termination) -> int:
    """Run `vla-capture FAMILY` on parsed arguments; returns the exit code."""
    threads = use_threads(arguments.threads)

    from vla_attention.capture.run_settings import run_settings
    from vla_attention.capture.store.store_writer import refuse_existing

    settings = run_settings(arguments)
    # An existing store or an unwritable place is an error now, before the minutes for loading a model.
    if settings.mode == "new" and settings.store.exists():
        refuse_existing(settings.store)
    check_writable(settings.store.parent, "--store")
    if arguments.output_dir is not None:
        check_writable(arguments.output_dir, "--output-dir")

    from vla_attention.capture.capture_run import run_capture
    from vla_attention.capture.device import load_torch
    from vla_attention.capture.rollout.progress import say

    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    family: PolicyFamily = arguments.family
    policy = family.build(arguments, device)
    run_capture(settings, policy, device, termination)
    if arguments.output_dir is None and not arguments.save_viz:
        say(f"Next: vla-analyze {settings.store}")
        return 0
    return run_analysis(arguments, settings.store, arguments.output_dir)
