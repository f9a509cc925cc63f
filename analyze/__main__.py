"""`vla-analyze`: the command line of stage two."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from vla_attention.analyze.commands import COMMANDS, DEFAULT_COMMAND
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import UnknownName, UserError, did_you_mean, listing

#: Episodes are measured by threads of our own (`vla_attention.analyze.stores.parallel`); products that each start threads only stand in their way.
_ONE_THREAD_EACH = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")
#: The collector need not look for cycles after every 700 of the ten thousands of token pieces and steps, which have none.
_OBJECTS_BETWEEN_COLLECTIONS = 5_000_000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: a mistake in what was given, said in one sentence)."""
    for name in _ONE_THREAD_EACH:  # read when numpy is imported, which is later
        os.environ.setdefault(name, "1")
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    words = sys.argv[1:] if argv is None else list(argv)
    name = words[0] if words[:1] and words[0] in COMMANDS else ""
    prog = f"vla-analyze {name}".strip()
    return run_command(prog, lambda: _run(name, words[1:] if name else words), "nothing was left half written.")


def _run(name: str, words: Sequence[str]) -> int:
    if not name:
        _refuse_misspelt_command(words)
    command = import_module(f"vla_attention.analyze.{name or DEFAULT_COMMAND}.command")
    parser = command.build_parser(prog=f"vla-analyze {name}") if name == DEFAULT_COMMAND else command.build_parser()
    try:
        return command.run(parser.parse_args(words))
    except UserError as error:
        raise _with_way_out(error) from error.__cause__


def _with_way_out(error: UserError) -> UserError:
    """Add to the error of a damaged episode what can be done about it."""
    from vla_attention.schemas.stores.store_format import CorruptEpisode

    if not isinstance(error, CorruptEpisode):
        return error
    return CorruptEpisode(
        f"{error} See all faults with vla-analyze verify; leave such episodes out with --skip-corrupt."
    )


def _refuse_misspelt_command(words: Sequence[str]) -> None:
    """A first word that is like a command and is no path is a slip, not a store."""
    if len(words) > 1 and not words[0].startswith("-") and not Path(words[0]).exists():
        near = did_you_mean(words[0], COMMANDS)
        if near:
            raise UnknownName(
                f"There is neither a command nor a store '{words[0]}'.{near} Commands: {listing(COMMANDS, 40)}."
            )


if __name__ == "__main__":
    sys.exit(main())
