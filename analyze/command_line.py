"""Running one command of `vla-analyze`: which one it is, and what all of them share."""

from __future__ import annotations

import argparse
import gc
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from pathlib import Path

from vla_attention.analyze.ask import question_parser, run_question
from vla_attention.analyze.registry import COMMANDS, DEFAULT_COMMAND
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import BadArgument, UnknownName, UserError, did_you_mean, listing
from vla_attention.schemas.former_commands import as_of_today
from vla_attention.schemas.threads import add_threads, use_threads

#: Episodes are measured in threads (`stores.parallel`); matrix products that start threads too make them slower.
_ONE_THREAD_EACH = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: Objects made between two runs of the garbage collector. Token pieces and steps are tens of thousands, without cycles;
#: Python's default of 700 would search them again and again.
_OBJECTS_BETWEEN_COLLECTIONS = 5_000_000


def run_command_line(given: Sequence[str], if_stopped: str, program: str = "vla-analyze") -> int:
    """Run the command that the arguments name; returns the exit code. if_stopped: what is said after a stop."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    name = given[0] if given[:1] and given[0] in COMMANDS else ""
    prog = f"{program} {name}" if name else "vla-attention analyze" if program == "vla-attention" else program
    return run_command(prog, lambda: _run(_words(given), program), if_stopped)


def is_store(word: str) -> bool:
    """Whether a word of a command line is the place of a store."""
    return word.rstrip("/").endswith(".zarr") or "://" in word


def _words(given: Sequence[str]) -> list[str]:
    """What was typed, with the words of today and the command first."""
    words = as_of_today(given)
    if words[:1] and words[0] not in COMMANDS and is_store(words[0]) and words[1:2] and words[1] in COMMANDS:
        return [words[1], words[0], *words[2:]]  # STORE words
    return words


def _run(words: Sequence[str], program: str) -> int:
    if any(word.partition("=")[0] == "--seed" for word in words):
        raise BadArgument("Intervals have no random draws any more: leave --seed out.")
    name = words[0] if words[:1] and words[0] in COMMANDS else ""
    arguments = words[1:] if name else words
    if not name:
        _refuse_misspelt_command(arguments)
    parser = build_parser(name)
    if program == "vla-attention":
        parser.prog = f"{program} {name or 'analyze'}"
    parsed = parser.parse_args(arguments)
    # The libraries read the numbers when they are imported, which the command does.
    use_threads(parsed.threads)
    os.environ.update(dict.fromkeys(_ONE_THREAD_EACH, "1"))
    try:
        with _cache_of(parsed), _engine(parsed), _pictures(parsed):
            return _answer(name or DEFAULT_COMMAND, parsed)
    except UserError as error:
        raise _with_way_out(error, can_skip=hasattr(parsed, "skip_corrupt")) from error.__cause__


def _answer(name: str, parsed: argparse.Namespace) -> int:
    if COMMANDS[name].folder:
        code: int = import_module(f"vla_attention.analyze.{name}.command").run(parsed)
        return code
    return run_question(name, parsed)


def build_parser(name: str) -> argparse.ArgumentParser:
    """The parser of one command with what all commands share; `""` is `vla-attention analyze STORE`."""
    parser: argparse.ArgumentParser
    if COMMANDS[name or DEFAULT_COMMAND].folder:
        command = import_module(f"vla_attention.analyze.{name or DEFAULT_COMMAND}.command")
        parser = (
            command.build_parser(prog=f"vla-attention analyze {name}")
            if name == DEFAULT_COMMAND
            else command.build_parser()
        )
    else:
        parser = question_parser(name)
    add_threads(
        parser,
        "threads that measure episodes, at most 4 (default: OMP_NUM_THREADS, else the cores of this process)",
    )
    if name != "cache":
        parser.add_argument(
            "--no-cache",
            action="store_true",
            help="measure again what was measured before (see vla-attention cache; VLA_CACHE=off does the same)",
        )
    return parser


def _cache_of(parsed: argparse.Namespace) -> AbstractContextManager[None]:
    """The cache that the arguments leave to the command."""
    if not getattr(parsed, "no_cache", False):
        return nullcontext()
    from vla_attention.analyze.cache.places import switched_off

    return switched_off()


def _pictures(parsed: argparse.Namespace) -> AbstractContextManager[None]:
    """The formats of pictures: a PDF takes longer than its PNG, and most are never opened."""
    if getattr(parsed, "pdf", True):
        return nullcontext()
    from vla_attention.analyze.show.picture_formats import pictures_saved_as

    return pictures_saved_as(("png",))


def _engine(parsed: argparse.Namespace) -> AbstractContextManager[object]:
    """Where `arguments.add_workers` says that episodes are worked on; nothing is imported for the default."""
    where = getattr(parsed, "scheduler", None)
    where = getattr(parsed, "workers", None) if where is None else where
    if where is None:
        return nullcontext()
    from vla_attention.analyze.stores.parallel import workers

    return workers(where)


def _with_way_out(error: UserError, can_skip: bool) -> UserError:
    """Add to the error of a damaged episode what the user can do."""
    from vla_attention.schemas.stores.store_format import CorruptEpisode

    if not isinstance(error, CorruptEpisode):
        return error
    skip = "; leave such episodes out with --skip-corrupt" if can_skip else ""
    return CorruptEpisode(f"{error} See all faults with vla-attention verify{skip}.")


def _refuse_misspelt_command(arguments: Sequence[str]) -> None:
    """Raise `UnknownName` for a first argument that resembles a command and is no path."""
    if len(arguments) > 1 and not arguments[0].startswith("-") and not Path(arguments[0]).exists():
        near = did_you_mean(arguments[0], COMMANDS)
        if near:
            raise UnknownName(
                f"There is neither a command nor a store '{arguments[0]}'.{near} Commands: {listing(COMMANDS, 40)}."
            )
