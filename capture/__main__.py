"""The command lines of stage one: `vla-attention capture ...`, and the published scripts' commands.

What they need is imported inside of them, so that Ctrl-C is a sentence from the first moment on.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from vla_attention.schemas.stop_signals import end_program, run_until_stopped

if TYPE_CHECKING:
    import argparse

_PROGRAM = "vla-attention capture"
#: What is said after Ctrl-C.
IF_STOPPED = "complete episodes are kept, continue with --resume."
#: Commands that record nothing, and what is said of them.
_RECORD_NOTHING = ("doctor", "slurm", "status", "tasks", "verify")
_IF_LOOKING = "nothing was left half written."


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, which is 2 after a mistake in the arguments."""
    given = sys.argv[1:] if argv is None else list(argv)
    if_stopped = _IF_LOOKING if given and given[0] in _RECORD_NOTHING else IF_STOPPED

    def run() -> int:
        from vla_attention.capture.commands.command_line import run_capture_command

        return run_capture_command(_PROGRAM, lambda: _parse(given), if_stopped)

    return run_until_stopped(_PROGRAM, run, if_stopped)


def _parse(given: Sequence[str]) -> argparse.Namespace:
    from vla_attention.capture.commands.arguments import build_parser
    from vla_attention.capture.commands.mistakes import refuse_other_tools_words

    refuse_other_tools_words(given)
    parsed: argparse.Namespace = build_parser(given).parse_args(given)
    return parsed


def evaluate_attention_ratio() -> NoReturn:
    """The console script `evaluate-attention-ratio`."""
    _end_published("evaluate-attention-ratio")


def evaluate_attention_ratio_cosmos() -> NoReturn:
    """The console script `evaluate-attention-ratio-cosmos`."""
    _end_published("evaluate-attention-ratio-cosmos")


def _end_published(name: str) -> NoReturn:
    def run() -> int:
        from vla_attention.capture.published.evaluate import evaluate

        return evaluate(name)

    end_program(run_until_stopped(name, run, IF_STOPPED))


if __name__ == "__main__":
    end_program(main())
