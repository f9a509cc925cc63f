"""`vla-attention`: one name for every command of the package, so that `uvx vla-attention ...` reaches all of them.

What they need is imported when they are called.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from vla_attention.schemas.stop_signals import end_program

_USAGE = """\
usage: vla-attention COMMAND ...

Does a vision-language-action policy look, or does it read?

  example [FOLDER]   copy the small stores that are shipped, and say what to ask them
  capture POLICY     run a policy and record its attention into a store (needs the extra [capture])

questions to a store (vla-attention COMMAND STORE)
{questions}

keeping stores
{keeping}

  help, --version

vla-attention COMMAND --help says more, --help-all everything. From Python: import vla_attention as va; va.open(STORE).
"""


def usage() -> str:
    """The help text."""
    from vla_attention.analyze.registry import COMMANDS as ANALYSES

    questions = {name: command.answers for name, command in ANALYSES.items() if not command.keeps}
    keeping = {name: command.answers for name, command in ANALYSES.items() if command.keeps}
    return _USAGE.format(questions=_lines(questions), keeping=_lines(keeping))


def _lines(commands: Mapping[str, str]) -> str:
    return "\n".join(f"  {name:<18} {answer}" for name, answer in commands.items())


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code of the command, 2 for a command that does not exist."""
    given = sys.argv[1:] if argv is None else list(argv)
    if not given or given[0] in ("-h", "--help", "--help-all", "help"):
        print(usage(), end="")
        return 0
    if given[0] in ("-V", "--version"):
        from vla_attention import __version__

        print(f"vla-attention {__version__}")
        return 0
    command = COMMANDS.get(given[0])
    if command is not None:
        return command(given[1:])
    from vla_attention.analyze.registry import COMMANDS as ANALYSES

    if given[0] in ANALYSES:
        return _analyses(given)
    from vla_attention.schemas.errors import did_you_mean, listing
    from vla_attention.schemas.safe_text import visible
    from vla_attention.schemas.stores.store_url import is_store

    name, known = visible(given[0]), [*COMMANDS, *ANALYSES]
    if is_store(given[0]):
        return _analyses(given)
    print(
        f"vla-attention: There is no command '{name}'.{did_you_mean(name, known)} "
        f"Commands: {listing(dict.fromkeys(known), 40)}. See vla-attention --help.",
        file=sys.stderr,
    )
    return 2


def _analyses(given: Sequence[str]) -> int:
    from vla_attention.analyze.__main__ import main as analyze

    return analyze(given)


def _capture(given: Sequence[str]) -> int:
    from vla_attention.capture.__main__ import main as capture

    return capture(given)


def _example(given: Sequence[str]) -> int:
    from vla_attention.example_stores.command import main as example

    return example(given)


#: Command -> what runs it; besides these, the commands that read stores.
COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "example": _example,
    "analyze": _analyses,  # `analyze words STORE` is `words STORE`
    "capture": _capture,
}


def program() -> NoReturn:
    """The console script `vla-attention`."""
    end_program(main())


if __name__ == "__main__":
    program()
