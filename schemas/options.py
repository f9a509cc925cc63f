"""Options that both command lines share: ranges of numbers, tasks, and the published names. Nothing heavy."""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import BadArgument, Note, listing, unknown_name

_RANGE = re.compile(r"(\d+)-(\d+)")
#: Numbers that a range may name; axes of stores are far shorter.
_MOST_IN_RANGE = 10_000
TASK_HELP = "task ids, ranges as 0-3, several as 0,5, or the instruction in quotes"


class Numbers(argparse.Action):
    """An action for values of `number_range` or `task_choice`: one list of them all."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Keep the numbers, and texts as they are."""
        chosen = [one for value in values for one in (value if isinstance(value, list) else [value])]
        setattr(namespace, self.dest, chosen)


def number_range(text: str) -> list[int]:
    """The type of an option of numbers: `3`, the range `0-2`, or several of them with commas between, `0,5-7`."""
    numbers: list[int] = []
    for part in text.strip().removesuffix(",").split(","):
        if matched := _RANGE.fullmatch(part.strip()):
            first, last = int(matched[1]), int(matched[2])
            if last < first or len(numbers) + last - first >= _MOST_IN_RANGE:
                raise argparse.ArgumentTypeError(f"'{text}' is no range; write the smaller number first, as 0-2")
            numbers += range(first, last + 1)
            continue
        try:
            numbers.append(int(part))
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"'{text}' is neither a number, nor a range as 0-2, nor several with commas between, as 0,5"
            ) from None
    return numbers


def task_choice(text: str) -> list[int] | str:
    """The type of `--task`: numbers, or the instruction of a task, which has letters."""
    return text if any(character.isalpha() for character in text) else number_range(text)


def add_task(group: argparse._ActionsContainer, dest: str, which: str) -> None:
    """`--task`, which the published scripts call `--task-id`; which: what it chooses, for the help."""
    options: dict[str, Any] = {"dest": dest, "type": task_choice, "nargs": "+", "action": Numbers, "metavar": "TASK"}
    group.add_argument("--task", **options, help=f"{which}: {TASK_HELP} (default: all)")
    group.add_argument("--task-id", **options, default=argparse.SUPPRESS, help=argparse.SUPPRESS)


class OutputPath(argparse.Action):
    """`--output` of a capture: `NAME.zarr` is the store, anything else a folder."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Keep the path as `store` or as `output_dir`."""
        path = Path(values)
        setattr(namespace, "store" if path.suffix == ".zarr" else "output_dir", path)


def add_capture_output(group: argparse._ActionsContainer, store: str, text: str) -> None:
    """`--output` of a command that writes stores. store: the metavar; text: the help.

    The published scripts call it `--output-dir`.
    """
    group.add_argument("--output", action=OutputPath, default=argparse.SUPPRESS, metavar=store, help=text)
    group.add_argument("--output-dir", type=Path, dest="output_dir", help=argparse.SUPPRESS)
    group.set_defaults(store=None)


def resolve_tasks(chosen: Sequence[int | str], instructions: Mapping[int, str], where: str) -> tuple[int, ...]:
    """The numbers of tasks that were chosen by number or by instruction, in that order, each once.

    Args:
        chosen: numbers, which are not checked, and instructions, in any case.
        instructions: of the tasks that exist, by number.
        where: what has them, for a sentence.

    Raises:
        UnknownName: no task has an instruction.
        BadArgument: a text without letters, which is no instruction, is no list of numbers either.
    """
    numbers: list[int] = []
    for one in chosen:
        if isinstance(one, int):
            numbers.append(one)
            continue
        named = [number for number, text in instructions.items() if _folded(text) == _folded(one)]
        if not named and not any(character.isalpha() for character in one):
            try:
                numbers += number_range(one)
            except argparse.ArgumentTypeError as error:
                raise BadArgument(f"{error}; tasks are named by numbers or by their instruction.") from None
            continue
        if not named:
            raise unknown_name(f"task of {where} with the instruction", one, instructions.values())
        if len(named) > 1:
            warnings.warn(
                Note(f"Tasks {listing(named)} of {where} have the instruction '{one}': all of them."), stacklevel=2
            )
        numbers += named
    return tuple(dict.fromkeys(numbers))


def _folded(text: str) -> str:
    return " ".join(text.casefold().split())
