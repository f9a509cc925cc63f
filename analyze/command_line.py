"""Running one command that reads stores: which one it is, and what all of them share."""

from __future__ import annotations

import argparse
import gc
import os
from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path

from vla_attention.analyze.ask import question_parser, run_question
from vla_attention.analyze.registry import COMMANDS, DEFAULT_COMMAND
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import UnknownName, UserError, did_you_mean, listing
from vla_attention.schemas.stores.store_url import is_store
from vla_attention.schemas.threads import add_threads, use_threads

#: Episodes are measured in threads (`stores.parallel`); matrix products that start threads too make them slower.
_ONE_THREAD_EACH = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: Objects made between two runs of the garbage collector. Token pieces and steps are tens of thousands, without cycles;
#: Python's default of 700 would search them again and again.
_OBJECTS_BETWEEN_COLLECTIONS = 5_000_000


def run_command_line(given: Sequence[str], if_stopped: str) -> int:
    """Run the command that the arguments name; returns the exit code. if_stopped: what is said after a stop."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    name, rest = _command(given)
    return run_command(f"vla-attention {name}", lambda: _run(name, rest), if_stopped)


def _command(given: Sequence[str]) -> tuple[str, list[str]]:
    """The command and its arguments: `words STORE`, `STORE words`, or `STORE`, of which the default one is asked."""
    words = list(given)
    if words[:1] and words[0] in COMMANDS:
        return words[0], words[1:]
    if words[:1] and is_store(words[0]) and words[1:2] and words[1] in COMMANDS:
        return words[1], [words[0], *words[2:]]
    return DEFAULT_COMMAND, words


def _run(name: str, arguments: Sequence[str]) -> int:
    if name == DEFAULT_COMMAND:
        _refuse_misspelt_command(arguments)
    parser = build_parser(name)
    parser.prog = f"vla-attention {name}"
    parsed = parser.parse_args(arguments)
    # The libraries read the numbers when they are imported, which the command does.
    use_threads(parsed.threads)
    os.environ.update(dict.fromkeys(_ONE_THREAD_EACH, "1"))
    try:
        with ExitStack() as stack:
            if getattr(parsed, "no_cache", False):
                from vla_attention.analyze.cache.places import switched_off

                stack.enter_context(switched_off())
            where = getattr(parsed, "scheduler", None) or getattr(parsed, "workers", None)
            if where is not None:
                from vla_attention.analyze.stores.parallel import workers

                stack.enter_context(workers(where))
            if not COMMANDS[name].folder:
                return run_question(name, parsed)
            code: int = import_module(f"vla_attention.analyze.{name}.command").run(parsed)
            return code
    except UserError as error:
        raise _with_way_out(error, can_skip=hasattr(parsed, "skip_corrupt")) from error.__cause__


def build_parser(name: str) -> argparse.ArgumentParser:
    """The parser of one command with what all commands share."""
    parser: argparse.ArgumentParser
    if COMMANDS[name].folder:
        parser = import_module(f"vla_attention.analyze.{name}.command").build_parser()
    else:
        parser = question_parser(name)
    if not COMMANDS[name].keeps:
        what = "threads that measure episodes, at most 4 (default: OMP_NUM_THREADS, else the cores of this process)"
        add_threads(parser, what)
        again = "measure again what was measured before (VLA_CACHE=off does the same)"
        parser.add_argument("--no-cache", action="store_true", help=again)
    return parser


def _with_way_out(error: UserError, can_skip: bool) -> UserError:
    """Add to the error of a damaged episode what the user can do."""
    from vla_attention.schemas.stores.store_format import CorruptEpisode

    if not isinstance(error, CorruptEpisode):
        return error
    skip = "; leave such episodes out with --skip-corrupt" if can_skip else ""
    return CorruptEpisode(f"{error} See all faults with vla-attention store verify{skip}.")


def _refuse_misspelt_command(arguments: Sequence[str]) -> None:
    """Raise `UnknownName` for a first argument that resembles a command and is no path."""
    if len(arguments) > 1 and not arguments[0].startswith("-") and not Path(arguments[0]).exists():
        near = did_you_mean(arguments[0], COMMANDS)
        if near:
            raise UnknownName(
                f"There is neither a command nor a store '{arguments[0]}'.{near} Commands: {listing(COMMANDS, 40)}."
            )
