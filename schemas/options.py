"""Options of the command lines from the fields of settings; and ranges of numbers, tasks. Imports nothing heavy.

A frozen dataclass of settings says every option once:

    num_episodes: int = option("episodes per task (default: %(default)s)", 5, least=1)

`add_options` gives a parser `--num-episodes`, and `read_options` makes the settings of what was parsed.
"""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from vla_attention.schemas.errors import BadArgument, Note, listing, unknown_name

_RANGE = re.compile(r"(\d+)-(\d+)")
#: Numbers that a range may name; axes of stores are far shorter.
_MOST_IN_RANGE = 10_000
T = TypeVar("T")


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
            if last < first:
                raise argparse.ArgumentTypeError(f"'{text}' is no range; write the smaller number first, as 0-2")
            if len(numbers) + last - first >= _MOST_IN_RANGE:
                raise argparse.ArgumentTypeError(
                    f"'{text}' is {last - first + 1:,} numbers; at most {_MOST_IN_RANGE:,}"
                )
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


def option(
    help: str,
    default: Any = MISSING,
    *,
    name: str = "",
    also: str = "",
    least: int | None = None,
    group: str = "",
    either: str = "",
    **argument: Any,
) -> Any:
    """A field of settings that is an option.

    Args:
        help: its help text.
        default: without one the settings have to be given a value that follows from others.
        name: of the option, where it is not the field's.
        also: another name of the option, which no help shows.
        least: the smallest number that is accepted.
        group: title of the group of options that begins here.
        either: a name; at most one of the options that share it can be given.
        argument: what argparse takes, where it does not follow from the field's type.
    """
    said = {"help": help, "name": name, "also": also, "least": least, "group": group, "either": either}
    return field(default=default, metadata={**said, "argument": argument})


def task_option(which: str, **more: Any) -> Any:
    """`--task`, which the published scripts call `--task-id`; which: what it chooses, for the help."""
    told: dict[str, Any] = {"type": task_choice, "nargs": "+", "action": Numbers, "metavar": "TASK"}
    text = f"{which}: task ids, ranges as 0-3, several as 0,5, or the instruction in quotes (default: all)"
    return option(text, None, name="task", also="task-id", **{"dest": "task_id", **told, **more})


def add_options(
    parser: argparse.ArgumentParser, settings: type, *, defaults: str = "", **here: str | Mapping[str, Any] | None
) -> None:
    """Add the options of settings.

    Args:
        parser: what takes them.
        settings: a dataclass with fields that are options.
        defaults: whose the defaults are, for the titles of groups; the help texts then name none.
        here: field -> its help text in this parser, or other things that argparse takes; None leaves the option out.
    """
    types = get_type_hints(settings)
    group: Any = parser
    exclusive: dict[str, Any] = {}
    for one in fields(settings):
        told = one.metadata
        if title := told.get("group"):
            title += f" (default: {defaults})" if defaults else ""
            known = [group for group in parser._action_groups if group.title == title]
            group = known[0] if known else parser.add_argument_group(title)
        changed = here.get(one.name, {})
        if "help" not in told or changed is None:
            continue
        argument = {"help": told["help"], "default": _parsed_default(one), **_of_type(types[one.name], one.default)}
        argument |= told["argument"] | ({"help": changed} if isinstance(changed, str) else dict(changed))
        if argument.get("action") == "append":
            del argument["nargs"]
        if defaults:
            argument["help"] = re.sub(r" \(default(: .*\)$|\))", "", argument["help"])
        place = group
        if either := told["either"]:
            place = exclusive[either] = exclusive.get(either) or group.add_mutually_exclusive_group()
        place.add_argument(f"--{_name(one)}", **argument)
        if told["also"]:
            hidden = {"default": argparse.SUPPRESS, "help": argparse.SUPPRESS, "dest": _destination(one)}
            place.add_argument(f"--{told['also']}", **{**argument, **hidden})


def read_options(settings: type[T], given: argparse.Namespace, **derived: Any) -> T:
    """Make settings of parsed arguments; what was not given keeps its default.

    Args:
        settings: a dataclass with fields that are options. Other fields are taken from the arguments of their name.
        given: the parsed arguments.
        derived: field -> value of fields that are not as they were given.

    Raises:
        BadArgument: a number is smaller than the least one.
    """
    values: dict[str, Any] = {}
    for one in fields(settings):  # type: ignore[arg-type]  # mypy knows no type of dataclasses
        value = getattr(given, _destination(one), None)
        if value is None:
            continue
        least = one.metadata.get("least")
        if least is not None and value < least:
            raise BadArgument(f"Cannot use --{_name(one)} {value}; expected at least {least}.")
        values[one.name] = tuple(value) if isinstance(value, list) else value
    return settings(**{**values, **derived})


def _name(one: Field[Any]) -> str:
    """The name of a field's option."""
    return str(one.metadata.get("name") or one.name.replace("_", "-"))


def _destination(one: Field[Any]) -> str:
    """The name of a field's option in parsed arguments."""
    return str(one.metadata.get("argument", {}).get("dest") or _name(one).replace("-", "_"))


def _parsed_default(one: Field[Any]) -> Any:
    if one.default is MISSING:
        return None
    return list(one.default) if isinstance(one.default, tuple) else one.default


def _of_type(kind: Any, default: Any) -> dict[str, Any]:
    """What argparse takes for a value of a type."""
    if get_origin(kind) in (Union, UnionType):
        kind = get_args(kind)[0]  # the other one is None
    if kind is bool:
        return {"action": argparse.BooleanOptionalAction if default else "store_true"}
    if get_origin(kind) is Literal:
        return {"choices": get_args(kind)}
    if get_origin(kind) is not tuple:
        return {"type": kind, "metavar": {int: "N", Path: "PATH"}.get(kind, "NAME")}
    if get_args(kind)[0] is int:
        return {"type": number_range, "nargs": "+", "action": Numbers, "metavar": "N"}
    return {"nargs": "+", "metavar": "NAME"}


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
