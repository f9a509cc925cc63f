"""`python -m examples.cubes_policy`: make the small policy, from demonstrations to shipped weights."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

from vla_attention.schemas.command_line import OneSentenceParser, run_command
from vla_attention.schemas.stop_signals import end_program, run_until_stopped

PROGRAM = "python -m examples.cubes_policy"

#: Sub-command -> what it does. Each is a module of that name here, with `add_arguments(parser)` and
#: `run(arguments)`, which returns the exit code.
COMMANDS: dict[str, str] = {
    "demonstrate": "record demonstrations of scripted experts",
    "train": "train the policy, or a control, on demonstrations",
    "export": "write a training's averaged weights as a checkpoint folder for vla-attention capture pi",
    "rates": "how often the episodes of a store solved their tasks, and what they touched first",
}

#: What a command says after Ctrl-C.
IF_STOPPED: dict[str, str] = {
    "demonstrate": "the parts that are whole are kept, run the same command again to go on.",
    "train": "the last checkpoint is kept, continue with --resume.",
    "export": "no checkpoint was written.",
    "rates": "nothing was written.",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a sub-command; returns the exit code, which is 2 after a mistake in the arguments."""
    # Set before MuJoCo is imported, because GPU nodes and CI have no display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    given = list(sys.argv[1:] if argv is None else argv)
    return run_until_stopped(PROGRAM, lambda: _run(given), "what is whole is kept.")


def _run(given: list[str]) -> int:
    parser = OneSentenceParser(prog=PROGRAM, description="Make the small pi0.5 of the suite cubes.")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=OneSentenceParser)
    # Only the chosen command's module is imported, because they need different parts of the installation.
    for name, title in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=title, description=title)
        if name in given[:1]:
            _module(name).add_arguments(subparser)
    arguments = parser.parse_args(given)
    return run_command(
        f"{PROGRAM} {arguments.command}",
        lambda: _module(arguments.command).run(arguments),
        IF_STOPPED[arguments.command],
    )


def _module(name: str) -> Any:
    return importlib.import_module(f"examples.cubes_policy.{name}")


if __name__ == "__main__":
    end_program(main())
