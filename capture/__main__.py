"""`vla-capture`: the command line of stage one."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vla_attention.capture.command_line import run_capture_command
from vla_attention.capture.jobs.termination import Termination


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, which is 2 after a mistake in the arguments."""
    arguments = sys.argv[1:] if argv is None else argv
    return run_capture_command("vla-capture", lambda termination: _run(arguments, termination), lambda: 0)


def _run(argv: Sequence[str], termination: Termination) -> int:
    from vla_attention.capture.arguments import build_parser

    arguments = build_parser(argv).parse_args(argv)
    exit_code: int = arguments.command(arguments, termination)
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
