"""`vla-attention`: one name for every command of the package, so that `uvx vla-attention ...` reaches all of them.

`vla-attention analyze ...` is `vla-analyze ...`, and `vla-attention capture ...` is `vla-capture ...`. What they need
is imported when they are called.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from vla_attention.schemas.stop_signals import end_program

_USAGE = """\
usage: vla-attention COMMAND ...

Does a vision-language-action policy look, or does it read?

  example [FOLDER]           copy the small stores that come along, and say what to ask them
  analyze STORE ...          questions to a store: ratios, words, objects, report ... (the same as vla-analyze)
  view STORE                 look at a store in the browser (the same as vla-analyze view)
  capture POLICY ...         run a policy and record its attention (the same as vla-capture; needs the extra [capture])
  completion bash|zsh        completion of commands and options for a shell
  --version                  the version

vla-attention COMMAND --help says more. From Python: import vla_attention as va; va.open(STORE).
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code of the command, 2 for a command that does not exist."""
    given = sys.argv[1:] if argv is None else list(argv)
    if not given or given[0] in ("-h", "--help", "help"):
        print(_USAGE, end="")
        return 0
    if given[0] in ("-V", "--version"):
        from vla_attention import __version__

        print(f"vla-attention {__version__}")
        return 0
    command = COMMANDS.get(given[0])
    if command is not None:
        return command(given[1:])
    from vla_attention.schemas.errors import did_you_mean, listing
    from vla_attention.schemas.safe_text import visible

    name = visible(given[0])
    print(
        f"vla-attention: There is no command '{name}'.{did_you_mean(name, COMMANDS)} "
        f"Commands: {listing(COMMANDS)}. See vla-attention --help.",
        file=sys.stderr,
    )
    return 2


def _analyze(given: Sequence[str]) -> int:
    from vla_attention.analyze.__main__ import main as analyze

    return analyze(given)


def _view(given: Sequence[str]) -> int:
    return _analyze(["view", *given])


def _capture(given: Sequence[str]) -> int:
    from vla_attention.capture.__main__ import main as capture

    return capture(given)


def _example(given: Sequence[str]) -> int:
    from vla_attention.example_stores.command import main as example

    return example(given)


def _completion(given: Sequence[str]) -> int:
    from vla_attention.completion import main as completion

    return completion(given)


#: Command -> what runs it.
COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "example": _example,
    "analyze": _analyze,
    "view": _view,
    "capture": _capture,
    "completion": _completion,
}


def program() -> NoReturn:
    """The console script `vla-attention`."""
    end_program(main())


if __name__ == "__main__":
    program()
