"""`vla-attention capture replay`: make policy calls on the frames of a data set, and record them into a store."""

from __future__ import annotations

import argparse

from vla_attention.capture.engine.progress import say
from vla_attention.capture.machine import load_torch
from vla_attention.capture.replay.arguments import is_policy_file
from vla_attention.capture.replay.policy_file import check_policy_file, load_policy_file
from vla_attention.capture.replay.replay_plan import plan_replay
from vla_attention.schemas.errors import plural
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.threads import Threads


def run_replay(arguments: argparse.Namespace, threads: Threads, termination: Termination) -> int:
    """Run `vla-attention capture replay` on parsed arguments; returns the exit code."""
    file = check_policy_file(arguments.policy) if is_policy_file(arguments.policy) else None
    plan = plan_replay(arguments, termination)
    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    if file is None:
        from vla_attention.capture.replay.family_replay import replay_with_family

        added = replay_with_family(arguments, plan, device)
    else:
        from vla_attention.capture.replay.file_replay import replay_with_file

        added = replay_with_file(arguments, plan, load_policy_file(file, device))
    say(f"{plural(added, 'episode')} added. Store: {plan.store}")
    plan.faults.raise_missing()
    base = getattr(arguments, "rerun_of", None)
    say(
        f"Next: vla-attention analyze {plan.store}"
        if base is None
        else f"Next: vla-attention compare {base} {plan.store}"
    )
    return 0
