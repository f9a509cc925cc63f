"""`vla-capture`: the command line of stage one."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from vla_attention.capture.command import check_writable, run_analysis, run_capture_command
from vla_attention.capture.jobs.termination import Termination
from vla_attention.schemas.errors import BadArgument


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: a mistake in what was given, said in one sentence)."""
    words = sys.argv[1:] if argv is None else argv
    return run_capture_command("vla-capture", lambda termination: _run(words, termination), lambda: 0)


def _run(argv: Sequence[str], termination: Termination) -> int:
    from vla_attention.capture.arguments import build_parser

    arguments = build_parser().parse_args(argv)
    if arguments.policy == "parity":
        return _parity(arguments)
    if arguments.policy == "status":
        from vla_attention.capture.jobs.status import print_status

        return print_status(arguments.stores, arguments.expected, as_json=arguments.json, check=arguments.check)
    if arguments.policy == "tasks":
        from vla_attention.capture.task_list import print_tasks

        return print_tasks(arguments.suite, array=arguments.array)
    return _capture(arguments, termination)


def _capture(arguments: argparse.Namespace, termination: Termination) -> int:
    from vla_attention.capture.arguments import run_settings
    from vla_attention.capture.store.store_writer import refuse_existing

    settings = run_settings(arguments)
    # A store in the way, or no place for one, is found before minutes are spent on loading a model.
    if settings.mode == "new" and settings.store.exists():
        refuse_existing(settings.store)
    check_writable(settings.store.parent, "--store")
    if arguments.output_dir is not None:
        check_writable(arguments.output_dir, "--output-dir")

    from vla_attention.capture.device import choose_device
    from vla_attention.capture.policy_choice import build_policy
    from vla_attention.capture.rollout.progress import say
    from vla_attention.capture.run import run_capture

    device = choose_device(arguments.device)
    policy = build_policy(arguments, device)
    results = run_capture(settings, policy, device, termination)
    solved = sum(result.success for result in results)
    say(f"{len(results)} episodes added, {solved} solved. Store: {settings.store}")
    if arguments.output_dir is None and not arguments.save_viz:
        say(f"Next: vla-analyze {settings.store}")
        return 0
    return run_analysis(arguments, settings.store, arguments.output_dir)


def _parity(arguments: argparse.Namespace) -> int:
    from vla_attention.capture.device import choose_device
    from vla_attention.capture.policies.cosmos.case import case_kind

    device = choose_device(arguments.device)
    if case_kind(arguments.case) is not None:
        from vla_attention.capture.policies.cosmos.parity import run_cosmos_parity

        if arguments.format is not None or arguments.limit is not None:
            raise BadArgument("Cosmos cases have one format and their own limits; leave out --format and --limit.")
        return run_cosmos_parity([arguments.case], as_json=arguments.json, device=device)
    from vla_attention.capture.policies.pi.parity import run_parity

    return run_parity(arguments.case, arguments.format, limit=arguments.limit, as_json=arguments.json, device=device)


if __name__ == "__main__":
    sys.exit(main())
