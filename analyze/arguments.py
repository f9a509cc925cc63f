"""Command-line arguments that the commands of `vla-analyze` share, and their values. Imports nothing heavy."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.options import Numbers, add_option, add_task, number_range

if TYPE_CHECKING:
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.analyze.show.answer import Answer


def output_place(text: str) -> Path:
    """The type of `--output`: a path that is in no store. It is looked at before hours of reading."""
    from vla_attention.schemas.stores.store_place import refuse_in_store

    try:
        refuse_in_store(Path(text), "write to")
    except BadArgument as error:
        raise argparse.ArgumentTypeError(str(error).removesuffix(".")) from None
    return Path(text)


def add_grouping(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """--grouping, --group and --ratio."""
    grouping = parser.add_argument_group("grouping")
    grouping.add_argument(
        "--grouping",
        metavar="NAME|FILE",
        help="default, instruction, cameras, objects, reference[:N], or a TOML file (default: default)",
    )
    grouping.add_argument(
        "--group", action="append", default=[], metavar="NAME=SELECTOR", help="one more group; may be repeated"
    )
    grouping.add_argument("--ratio", metavar="A,B/C", help="groups of the ratio's numerator and denominator")
    return grouping


def add_site_and_tasks(chosen: argparse._ArgumentGroup) -> None:
    """--site and --task."""
    chosen.add_argument(
        "--site",
        metavar="NAME",
        help="softmax family: joint (pi), self or cross (Cosmos), or others that --list shows; default: the first one",
    )
    add_task(chosen, "tasks", "tasks", was=("--tasks",))


def add_selection(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """--site, --layers, --denoise, --heads, --task and --skip-corrupt, and where episodes are measured."""
    add_workers(parser)
    chosen = parser.add_argument_group("selection")
    add_site_and_tasks(chosen)
    numbers: dict[str, Any] = {"type": number_range, "nargs": "+", "action": Numbers, "metavar": "N"}
    chosen.add_argument("--layers", **numbers, help="layers, or ranges as 0-2 (default: all recorded)")
    add_option(
        chosen,
        "--denoise",
        was=("--denoise-steps",),
        nargs="+",
        metavar="STEP",
        help="denoise steps, first, last or all (default: all recorded)",
    )
    chosen.add_argument("--heads", **numbers, help="heads, or ranges as 0-2 (default: all recorded)")
    chosen.add_argument(
        "--skip-corrupt",
        action="store_true",
        help="check every episode first, and leave out, by name, those that are damaged or hold no replan",
    )
    return chosen


def add_workers(parser: argparse.ArgumentParser) -> None:
    """--workers and --scheduler; `__main__` hands episodes to what they name."""
    where = parser.add_argument_group("where episodes are read").add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, metavar="N", help="N processes of this machine, one thread each (default: threads)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="the workers of a running dask scheduler, as tcp://HOST:8786"
    )


def add_intervals(parser: argparse.ArgumentParser) -> None:
    """--intervals; its values are those of `statistics.intervals.Estimand`."""
    parser.add_argument(
        "--intervals",
        choices=("tasks-like-these", "these-tasks"),
        default="tasks-like-these",
        help="what intervals over several tasks are about: tasks like these, with families of related tasks as units; "
        "these tasks (default: %(default)s; see docs/statistics.md)",
    )


def add_question(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """--grouping and the like, the selection, and --intervals; returns the group of the selection."""
    add_grouping(parser)
    selection = add_selection(parser)
    add_intervals(parser)
    return selection


def add_output(parser: argparse.ArgumentParser, default: str = "results/STORE/GROUPING") -> argparse._ArgumentGroup:
    """--output, --no-plots and --pdf."""
    output = parser.add_argument_group("output")
    output.add_argument("--output", type=output_place, metavar="PATH", help=f"folder (default: {default})")
    pictures = output.add_mutually_exclusive_group()
    pictures.add_argument("--no-plots", action="store_true", help="numbers only")
    add_pdf(pictures)
    return output


def add_pdf(output: argparse._ActionsContainer) -> None:
    """--pdf."""
    output.add_argument("--pdf", action="store_true", help="pictures as PDF too (takes twice the time)")


def settings_of(arguments: argparse.Namespace) -> AnalysisSettings:
    """The settings in the parsed arguments; those that a command has no argument for keep their defaults."""
    from dataclasses import fields

    from vla_attention.analyze.measures.question_settings import AnalysisSettings

    given = {"groups": "group"}
    values: dict[str, Any] = {}
    for field in fields(AnalysisSettings):
        name = given.get(field.name, field.name)
        if hasattr(arguments, name):
            value = getattr(arguments, name)
            values[field.name] = tuple(value) if isinstance(value, list) else value
    return AnalysisSettings(**values)


def show(answer: Answer, folder: Path, arguments: argparse.Namespace) -> int:
    """Show an answer as the arguments of `add_output` say; returns the exit code."""
    return answer.show(folder, pictures=not arguments.no_plots)
