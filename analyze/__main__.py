"""The command lines of stage two: `vla-attention COMMAND STORE`, and the published `parse-attention-ratio-results`.

What they need is imported inside of them, so that Ctrl-C is a sentence from the first moment on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import NoReturn

from vla_attention.schemas.stop_signals import end_program, run_until_stopped

#: What is said after a stop: every file appears whole or not at all.
IF_STOPPED = "nothing was left half written."


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: an argument or a store is wrong, and one sentence says how)."""
    given = sys.argv[1:] if argv is None else list(argv)

    def run() -> int:
        from vla_attention.analyze.command_line import run_command_line

        return run_command_line(given, IF_STOPPED)

    return run_until_stopped("vla-attention", run, IF_STOPPED)


def parse_attention_ratio_results() -> NoReturn:
    """The console script `parse-attention-ratio-results`."""

    def run() -> int:
        from vla_attention.analyze.published.parse_results import main as parse

        return parse()

    end_program(run_until_stopped("parse-attention-ratio-results", run, IF_STOPPED))


if __name__ == "__main__":
    end_program(main())
