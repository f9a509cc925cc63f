"""The settings of a question: as the functions take them, and as keywords of the Python API."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypedDict

from vla_attention.analyze.statistics.intervals import Estimand
from vla_attention.schemas.errors import BadArgument, did_you_mean, listing, unknown_name


@dataclass(frozen=True)
class AnalysisSettings:
    """What a user asks for; None means the default. `vla_attention.analyze.options` reads it from a command line."""

    grouping: str | None = None
    groups: tuple[str, ...] = field(default=(), metadata={"name": "group"})  # of its option
    ratio: str | None = None
    layers: tuple[int, ...] | None = None
    denoise: tuple[str, ...] | None = None
    heads: tuple[int, ...] | None = None
    per_head: bool = False
    tasks: tuple[int | str, ...] | None = None
    site: str | None = None
    intervals: Estimand = Estimand.TASKS_LIKE_THESE
    skip_corrupt: bool = False
    units: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        known = [member.value for member in Estimand]
        if self.intervals not in known:
            raise unknown_name("kind of intervals", self.intervals, known)
        object.__setattr__(self, "intervals", Estimand(self.intervals))


class SettingKeywords(TypedDict, total=False):
    """The keywords that every method of the Python API takes: the names of `AnalysisSettings`, plain Python values.

    Each means the same as the option of its name on the command line.

    Keys:
        grouping: a built-in grouping or the path of a TOML file.
        groups: further groups, from name to selector or list of selectors; or a list of "NAME=SELECTOR".
        ratio: "A,B/C", or a pair (numerator, denominator) of names or lists of names.
        layers, heads: a number or several.
        tasks: a number or an instruction, or several.
        denoise: "first", "last", "all", a number or several.
        per_head: whether heads are kept apart.
        site: the softmax family.
        intervals: what intervals are about: "tasks-like-these" or "these-tasks".
        skip_corrupt: whether damaged and empty episodes are left out.
        units: groups of dimensions of the action in which effects are told, "NAME=DIMENSIONS:UNIT" or several.
    """

    grouping: str | Path | None
    groups: Mapping[str, str | Sequence[str]] | Sequence[str]
    ratio: str | tuple[str | Sequence[str], str | Sequence[str]] | None
    layers: int | Sequence[int] | None
    denoise: int | str | Sequence[int | str] | None
    heads: int | Sequence[int] | None
    per_head: bool
    tasks: int | str | Sequence[int | str] | None
    site: str | None
    intervals: str
    skip_corrupt: bool
    units: str | Sequence[str]


def settings_from_keywords(**keywords: Any) -> AnalysisSettings:
    """Keywords of the Python API as `AnalysisSettings`; see `SettingKeywords`.

    >>> settings_from_keywords(layers=25, groups={"bowl": "word:bowl"}, ratio=(["base", "wrist"], "bowl")).ratio
    'base,wrist/bowl'

    Raises:
        BadArgument: a keyword does not exist, or its value cannot be used.
    """
    known = [field.name for field in fields(AnalysisSettings)]
    values: dict[str, Any] = {}
    for name, value in keywords.items():
        if name not in known:
            raise BadArgument(f"Unknown setting '{name}'.{did_you_mean(name, known)} Existing: {listing(known, 20)}.")
        values[name] = _CONVERT[name](value) if name in _CONVERT and value is not None else value
    return AnalysisSettings(**values)


def _several(value: Any) -> list[Any]:
    return [value] if isinstance(value, (int, str)) else list(value)


def _whole_numbers(value: int | Sequence[int]) -> tuple[int, ...]:
    try:
        return tuple(int(item) for item in _several(value))
    except (TypeError, ValueError):
        raise BadArgument(f"Cannot use {value!r} as numbers; expected a whole number or several.") from None


def _tasks(value: int | str | Sequence[int | str]) -> tuple[int | str, ...]:
    return tuple(item if isinstance(item, str) else _whole_numbers(item)[0] for item in _several(value))


def _groups(value: Mapping[str, str | Sequence[str]] | Sequence[str]) -> tuple[str, ...]:
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, Mapping):
        return tuple(value)
    return tuple(f"{name}={union_of(selectors)}" for name, selectors in value.items())


def union_of(selectors: str | Sequence[str]) -> str:
    """Selectors as one."""
    return selectors if isinstance(selectors, str) else " | ".join(f"({selector})" for selector in selectors)


def _ratio(value: str | tuple[str | Sequence[str], str | Sequence[str]]) -> str:
    if isinstance(value, str):
        return value
    if len(value) != 2:
        raise BadArgument(f"Cannot use {value!r} as a ratio; expected 'A,B/C' or a pair (numerator, denominator).")
    return "/".join(side if isinstance(side, str) else ",".join(side) for side in value)


_CONVERT: dict[str, Any] = {
    "grouping": str,
    "groups": _groups,
    "ratio": _ratio,
    "layers": _whole_numbers,
    "heads": _whole_numbers,
    "tasks": _tasks,
    "units": lambda value: tuple(map(str, _several(value))),
    "denoise": lambda value: tuple(map(str, _several(value))),
}
