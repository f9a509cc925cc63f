"""The options of questions, once, and what was given as settings. Imports nothing heavy."""

from __future__ import annotations

import argparse
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.options import Numbers, add_options, number_range, read_options, task_option
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.schemas.stores.store_url import StorePlace

#: Characters of a folder's name; file systems take 255 bytes.
_LONGEST_NAME = 100
_NUMBERS: dict[str, Any] = {"type": number_range, "nargs": "+", "action": Numbers, "metavar": "N"}
#: What a table may keep apart.
AXES = ("layer", "head", "denoise", "replan", "time", "task", "family", "episode", "outcome", "camera")
#: Option -> what argparse takes. Those of `AnalysisSettings` have its names; the others are arguments of the command.
OPTIONS: dict[str, dict[str, Any]] = {
    "layers": {**_NUMBERS, "help": "layers, or ranges as 0-2 (default: all recorded)"},
    "denoise": {
        "nargs": "+", "metavar": "STEP", "help": "denoise steps, first, last or all (default: all recorded)",
    },
    "heads": {**_NUMBERS, "help": "heads, or ranges as 0-2 (default: all recorded)"},
    "site": {"metavar": "NAME", "help": "softmax family: joint (pi), self or cross (Cosmos) (default: the first)"},
    "grouping": {
        "metavar": "NAME|FILE",
        "help": "default, instruction, cameras, objects, reference[:N], or a TOML file (default: default)",
    },
    "group": {
        "action": "append", "default": [], "metavar": "NAME=SELECTOR", "help": "one more group; may be repeated",
    },
    "ratio": {"metavar": "A,B/C", "help": "groups of the ratio's numerator and denominator"},
    "intervals": {
        "choices": ("tasks-like-these", "these-tasks"), "default": "tasks-like-these",
        "help": "what intervals over several tasks are about (default: %(default)s; see docs/statistics.md)",
    },
    "twins": {
        "type": store_place, "metavar": "STORE", "help": "a store in which the same initial states are solved",
    },
    "allow_mismatch": {
        "action": "append", "default": [], "metavar": "FIELD",
        "help": "compare although the runs differ in this field, of family, suite, seed, protocol, image_size, "
        "wait_steps, replan_steps, max_steps, layers, denoise_steps, heads, queries, depth, layout, cameras, "
        "processing, simulator; may be repeated",
    },
    "by": {
        "type": lambda text: tuple(part for part in text.split(",") if part), "default": (), "metavar": "AXIS,...",
        "help": f"keep apart: one or several of {', '.join(AXES)}",
    },
    "iou": {
        "action": argparse.BooleanOptionalAction, "default": True,
        "help": "pointing game and IoU of maps and objects, which take most of the time (default: yes)",
    },
    "without_sinks": {
        "nargs": "?", "const": "", "metavar": "RULE",
        "help": "take out tokens that take far more than their share in most heads, and list them; a rule as "
        "factor=10,share=0.5,mass=0.3,heads=0.25 (these) says which",
    },
    "save_viz": {"action": "store_true", "help": "also a picture per episode and layer"},
    "num_episodes": {"type": int, "default": 2, "metavar": "N", "help": "with pictures (default: %(default)s)"},
    "num_replans": {"type": int, "default": 8, "metavar": "N", "help": "of each, at most (default: %(default)s)"},
    "episode": {"type": int, "metavar": "N", "help": "the one to show"},
    "replans": {"type": int, "nargs": "+", "metavar": "N", "help": "policy calls to show, from 0"},
    "cameras": {"nargs": "+", "metavar": "NAME", "help": "cameras to show (default: all that the policy sees)"},
    "outline": {
        "action": "append", "default": [], "metavar": "NAME=SELECTOR", "help": "draw a line around a group's patches",
    },
    "smooth": {"action": "store_true", "help": "attention changes smoothly between patches"},
    "video": {"choices": ("gif", "mp4"), "help": "also a film of each episode"},
    "fps": {"type": float, "default": 4.0, "metavar": "X", "help": "policy calls a second (default: %(default)s)"},
    "units": {
        "action": "append", "default": [], "metavar": "NAME=DIMENSIONS:UNIT",
        "help": "tell effects by this group of the action's dimensions, as arm=0-5:rad; may be repeated (default: cm "
        "and degrees of the hand where they are known, else as the policy's own actions are normalised)",
    },
    "open": {"action": "store_true", "help": "show the page in the browser"},
    "list": {"action": "store_true", "help": "what the stores hold, and what the grouping takes of it"},
}  # fmt: skip
#: What people type who know other programs, and the published scripts -> what it is called here.
INSTEAD = {
    "--output": "--output FOLDER says where the files go.",
    "-o": "--output FOLDER says where the files go.",
    "--plot": "Pictures are drawn unless --no-plots is given.",
    "--plots": "Pictures are drawn unless --no-plots is given.",
    "--format": "Tables are Parquet files; with --csv they are CSV files.",
}
_PAGES = {".html", ".htm"}
#: Endings of files, which no folder of results has.
_FILES = _PAGES | {".csv", ".json", ".parquet", ".png", ".pdf", ".svg", ".txt", ".md", ".tex", ".gif", ".mp4"}


def output_place(text: str) -> Path:
    """The type of a path that is in no store. It is looked at before hours of reading."""
    from vla_attention.schemas.stores.store_place import refuse_in_store

    try:
        refuse_in_store(Path(text), "write to")
    except BadArgument as error:
        raise argparse.ArgumentTypeError(str(error).removesuffix(".")) from None
    return Path(text)


def results_place(text: str, page: bool = False) -> Path:
    """The type of `--output`: a folder, or for a page a file that ends with .html."""
    path = output_place(text)
    if path.suffix.lower() in _FILES - (_PAGES if page else set()) and not path.is_dir():
        expected = f"a folder, {'or a file FILE.html' if page else 'in which result.json, tables and pictures are'}"
        raise argparse.ArgumentTypeError(f"{text} is called like a file of another kind; expected {expected}")
    return path


def add_workers(parser: argparse.ArgumentParser) -> None:
    """--workers and --scheduler."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="read episodes in N processes (default: threads)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="or in the workers of a dask scheduler, tcp://HOST:8786")


@dataclass(frozen=True)
class _Tasks:
    tasks: tuple[int | str, ...] | None = task_option("tasks", dest="tasks")


def add_question(parser: argparse.ArgumentParser, names: tuple[str, ...]) -> None:
    """--task, the named options and --skip-corrupt."""
    add_options(parser, _Tasks)
    for name in names:
        parser.add_argument(f"--{name.replace('_', '-')}", **OPTIONS[name])
    damaged = "leave out episodes that are damaged or empty, by name"
    parser.add_argument("--skip-corrupt", action="store_true", help=damaged)
    add_workers(parser)


def add_output(parser: argparse.ArgumentParser, command: str, page: bool = False) -> None:
    """--output; of a question, whose answer is no page, also --csv, --no-plots, --pdf and --style."""
    where = f"folder{', or a file FILE.html' if page else ''} (default: results/PATH OF STORE/{command})"
    place = partial(results_place, page=page)
    parser.add_argument("--output", type=place, metavar="PATH" if page else "FOLDER", help=where)
    if page:
        return
    parser.add_argument("--csv", action="store_true", help="tables as CSV instead of Parquet")
    pictures = parser.add_mutually_exclusive_group()
    pictures.add_argument("--no-plots", action="store_true", help="numbers only")
    pictures.add_argument("--pdf", action="store_true", help="pictures as PDF too")
    parser.add_argument(
        "--style", choices=("screen", "paper"), default="screen",
        help="paper: pictures for print, without titles, with caption files (default: %(default)s)",
    )  # fmt: skip


def settings_of(given: argparse.Namespace) -> AnalysisSettings:
    """The settings among the given options; those that a command does not take keep their defaults."""
    from vla_attention.analyze.measures.question_settings import AnalysisSettings

    return read_options(AnalysisSettings, given)


def results_folder(stores: Sequence[StorePlace], command: str, given: argparse.Namespace) -> Path:
    """`results/PATH OF STORE/COMMAND`, with the options that change the answer in its name.

    No two stores have one folder, and none is outside of `results`. Further runs of a comparison are named as well, by
    their file where they lie beside the first.
    """
    path, *others = (_path_of(store) for store in stores)
    beside = [one.name if one.parent == path.parent else _with_digest(one.name, str(one)) for one in others]
    command = "-".join([command, *beside])
    said = []
    for name in ("tasks", *OPTIONS):
        value = getattr(given, name, None)
        # An option without its value ("") and episode 0 were given too.
        if value is None or value is False or value in ([], ()) or value == OPTIONS.get(name, {}).get("default"):
            continue
        values = value if isinstance(value, list | tuple) else [] if value is True or value == "" else [value]
        said.append("-".join([name, *map(str, values)]))
    name = file_part("_".join([command, *said]))
    if len(name) > _LONGEST_NAME:
        name = _with_digest(name[:_LONGEST_NAME], name)
    return Path("results", path, name)


def _path_of(store: StorePlace) -> Path:
    """The path below `results` of a store: that of NAME.zarr below the working folder as it is, without the ending.

    Any other (outside of that folder, with another ending, at an address) ends with a digest of all of it, so that it
    cannot be that of a store below.
    """
    if isinstance(store, Path):
        # `..` would lead out of `results`, and behind a link it is not the folder above.
        place = Path(os.path.realpath(store)) if ".." in store.parts else store.absolute()
        is_below = Path.cwd() in place.parents
        if place.suffix == STORE_SUFFIX and is_below:
            return place.relative_to(Path.cwd()).with_suffix("")
        parts, whole = place.relative_to(Path.cwd() if is_below else place.anchor).parts, str(place)
    else:
        whole = str(store)
        parts = tuple(part for part in whole.split("://", 1)[1].split("/") if part not in ("", ".", ".."))
    *above, name = (file_part(part) for part in parts or ("root",))
    return Path(*above, _with_digest(name.removesuffix(STORE_SUFFIX), whole))


def _with_digest(name: str, whole: str) -> str:
    return f"{name}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"
