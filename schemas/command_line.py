"""What both command lines share: parsers, byte counts, and mistakes that end with one sentence and exit code 2."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from collections.abc import Callable
from typing import NoReturn

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.safe_text import visible, visible_output

#: Columns of a help text's description.
_HELP_WIDTH = 100


class OneSentenceParser(argparse.ArgumentParser):
    """An argument parser whose mistakes read like all the others."""

    def error(self, message: str) -> NoReturn:
        """Print the problem and where help is; exit code 2."""
        self.exit(2, f"{self.prog}: {message}. See {self.prog} --help.\n")


def command_parser(prog: str, description: str, examples: str = "", usage: str | None = None) -> OneSentenceParser:
    """A parser whose help shows the description, wrapped, and below the arguments the examples as they are."""
    return OneSentenceParser(
        prog=prog,
        usage=usage,
        description=textwrap.fill(description, _HELP_WIDTH),
        epilog=examples or None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def format_bytes(count: float) -> str:
    """A byte count with 3 significant digits and a decimal unit: 1.23 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def run_command(program: str, command: Callable[[], int], if_stopped: str) -> int:
    """Run a command and return its exit code; a `UserError` becomes one sentence and 2, Ctrl-C a sentence and 130.

    Control characters in what it prints are made visible (`safe_text.visible_output`).
    """
    with visible_output():
        return _run(program, command, if_stopped)


def _run(program: str, command: Callable[[], int], if_stopped: str) -> int:
    try:
        return command()
    except UserError as error:
        # One line, whatever a name in it holds: a line of its own could pass for another message.
        print(f"{program}: {visible(str(error))}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains when it flushes
        return 141
    except KeyboardInterrupt:
        print(f"\n{program}: stopped; {if_stopped}", file=sys.stderr)
        return 130
