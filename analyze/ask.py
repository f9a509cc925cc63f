"""Asking a question from a command line or from Python: its parser, its checked question, its result on a screen."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.analyze.options import (
    INSTEAD,
    OPTIONS,
    add_output,
    add_question,
    results_folder,
    settings_of,
)
from vla_attention.analyze.registry import COMMANDS, Command
from vla_attention.schemas.command_line import OneSentenceParser
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from vla_attention.analyze.core.result import Result
    from vla_attention.analyze.core.runs import RunArgument
    from vla_attention.analyze.measures.question import KnownEpisodes, Question
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.schemas.stores.reader import Store


def question_parser(name: str) -> OneSentenceParser:
    """The parser of a question, made from its line in the registry."""
    command = COMMANDS[name]
    examples = "".join(f"  vla-attention {line}\n" for line in command.examples)
    answers = f"{command.answers[0].upper()}{command.answers[1:]}."
    parser = OneSentenceParser(prog=f"vla-attention {name}", description=answers, epilog=f"examples:\n{examples}")
    if command.runs:
        runs = "STORE, or NAME=STORE[,STORE ...] for a run of several stores; two or more"
        parser.add_argument("runs", nargs="+", metavar="RUN", help=runs)
    elif command.data:
        what = "a LeRobotDataset: a folder, ORG/NAME or ORG/NAME@REVISION of the hub; or a store NAME.zarr"
        parser.add_argument("place", metavar="DATA", help=what)
        parser.add_argument(
            "--num-episodes", type=int, metavar="N", help="read N episodes, evenly over all (default: 5000 at most)"
        )
    else:
        parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    parser.instead = INSTEAD | _of_other_questions(command)
    if not command.data:
        add_question(parser, command.options)
    add_output(parser, name, command.page)
    return parser


def _of_other_questions(command: Command) -> dict[str, str]:
    """Options that this question has not -> which have them."""
    others = {option: [name for name, one in COMMANDS.items() if option in one.options] for option in OPTIONS}
    return {
        f"--{option.replace('_', '-')}": f"It is an option of {' and '.join(names)}."
        for option, names in others.items()
        if names and option not in command.options
    }


def run_question(name: str, given: argparse.Namespace) -> int:
    """Answer a question: files, and what fits a screen; returns the exit code."""
    from vla_attention.schemas.stores.reader import open_store

    if COMMANDS[name].data:
        from vla_attention.analyze.commands.data import data
        from vla_attention.analyze.core.data_episodes import read_episodes

        folder = given.output or results_folder([Path(given.place)], name, given)
        return _show(data(read_episodes(given.place, given.num_episodes)), folder, given)
    own = {option: getattr(given, option) for option in COMMANDS[name].options if option not in (*_settings(), "open")}
    if COMMANDS[name].runs:
        from vla_attention.analyze.core.runs import parse_runs

        runs = parse_runs(given.runs)
        folder = given.output or results_folder([run.paths[0] for run in runs], name, given)
        return _show(compared(runs, settings_of(given), **own), folder, given)
    stores = [open_store(place) for place in given.stores]
    folder = given.output or results_folder(given.stores[:1], name, given)
    if COMMANDS[name].page:
        return _write_page(name, stores, settings_of(given), own, folder, given.open)
    return _show(answer_to(name, stores, settings_of(given), own), folder, given)


def _show(result: Result, folder: Path, given: argparse.Namespace) -> int:
    """Write a result's files, print what fits a screen."""
    from vla_attention.analyze.render.answer import Answer
    from vla_attention.analyze.render.terminal import screen

    answer = Answer.of(result)
    formats = ("png", "pdf") if given.pdf else ()
    files = answer.save(folder, given.csv, not given.no_plots, given.style, formats)
    endings = sorted({file.suffix for file in files})
    print(screen(answer, last=[f"{len(files)} files in {folder} ({', '.join(f'*{ending}' for ending in endings)})."]))
    return 0


def _write_page(
    name: str, stores: Sequence[Store], settings: AnalysisSettings, own: Mapping[str, Any], place: Path, opens: bool
) -> int:
    from vla_attention.analyze.render.browser import open_page

    path = write_page(name, stores, settings, own, place)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB.{'' if opens else ' Open it in a browser.'}")
    if opens and (refused := open_page(path)):
        print(refused)
    return 0


def write_page(
    name: str, stores: Sequence[Store], settings: AnalysisSettings, own: Mapping[str, Any], place: Path
) -> Path:
    """Write the page of several results; returns its path.

    place: a file that ends with .html, or a folder, in which NAME.html is written.
    """
    from vla_attention import __version__
    from vla_attention.analyze.render.files import write_text, writing
    from vla_attention.analyze.render.page import page
    from vla_attention.schemas.errors import BadArgument

    is_page = place.suffix.lower() in (".html", ".htm")
    if place.is_file() and not is_page:
        raise BadArgument(f"Cannot write the page to the file {place}; expected a folder, or a file FILE.html.")
    path = place if is_page and not place.is_dir() else place / f"{name}.html"
    results: list[Result] = _function(name)(_question(COMMANDS[name], stores, settings, None), **own)
    text = page(results[0].about[0], results, __version__)
    with writing("the page", path, "another path"):
        write_text(path, text)
    return path


def _function(name: str) -> Any:
    return getattr(import_module(f"vla_attention.analyze.commands.{name}"), name)


def answer_to(
    name: str,
    stores: Sequence[Store],
    settings: AnalysisSettings,
    own: Mapping[str, Any] | None = None,
    known: KnownEpisodes | None = None,
) -> Result:
    """Ask a question of stores.

    Args:
        name: of the question in the registry.
        stores: of one policy and one kind of recording.
        settings: what is selected.
        own: the question's own options.
        known: what earlier questions about the same stores have read.
    """
    from vla_attention.schemas.stores.reader import open_store

    command, own = COMMANDS[name], dict(own or {})
    if own.get("twins") is not None:
        own["twins"] = _question(command, [open_store(own["twins"])], settings, None)
    result: Result = _function(name)(_question(command, stores, settings, known), **own)
    return result


def compared(runs: Sequence[RunArgument], settings: AnalysisSettings, allow_mismatch: Sequence[str] = ()) -> Result:
    """What changed between runs, see `commands.compare`."""
    from vla_attention.analyze.commands.compare import compare
    from vla_attention.analyze.core.runs import open_runs

    return compare(open_runs(runs, settings, allow_mismatch), allow_mismatch)


def _question(
    command: Command, stores: Sequence[Store], settings: AnalysisSettings, known: KnownEpisodes | None
) -> Question:
    """The checked question, at the wanted site or the first one that the command can ask."""
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.stores.selection import site_that
    from vla_attention.schemas.errors import BadArgument

    if command.site:
        root = stores[0].attributes
        site = site_that(root, settings.site, lambda site: any(span.kind in command.site for span in site.spans))
        if site is None:
            raise BadArgument(f"Site '{settings.site or root.sites[0].name}': {command.needs}.")
        settings = replace(settings, site=site)
    return ask(stores, settings, known)


def _settings() -> set[str]:
    from dataclasses import fields

    from vla_attention.analyze.measures.question_settings import AnalysisSettings

    return {field.name for field in fields(AnalysisSettings)} | {"group"}
