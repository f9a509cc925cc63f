"""Settings as plain Python values: what the methods of the Python API take as keywords."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypedDict

from vla_attention.analyze.measures.question import AnalysisSettings
from vla_attention.schemas.errors import BadArgument, did_you_mean, listing


class Settings(TypedDict, total=False):
    """Keywords that every method takes; what they mean is what the options of the same names mean on the command line.

    grouping: a built-in grouping or a TOML file. groups: further groups, name to selector or selectors (or a list of "NAME=SELECTOR").
    ratio: "A,B/C", or a pair of names or lists of names. layers, heads, tasks: a number or several. denoise: "first", "last",
    "all" or numbers. per_head: keep heads apart. site: the softmax family. seed: of the bootstrap. skip_corrupt: leave out damaged
    and empty episodes.
    """

    grouping: str | Path | None
    groups: Mapping[str, str | Sequence[str]] | Sequence[str]
    ratio: str | tuple[str | Sequence[str], str | Sequence[str]] | None
    layers: int | Sequence[int] | None
    denoise: int | str | Sequence[int | str] | None
    heads: int | Sequence[int] | None
    per_head: bool
    tasks: int | Sequence[int] | None
    site: str | None
    seed: int
    skip_corrupt: bool


def analysis_settings(**settings: Any) -> AnalysisSettings:
    """Plain keywords as `AnalysisSettings`; see `Settings`.

    >>> analysis_settings(layers=25, groups={"bowl": "word:bowl"}, ratio=(["base", "wrist"], "bowl")).ratio
    'base,wrist/bowl'

    Raises:
        BadArgument: a keyword does not exist, or its value has no meaning.
    """
    known = [field.name for field in fields(AnalysisSettings)]
    values: dict[str, Any] = {}
    for name, value in settings.items():
        if name not in known:
            raise BadArgument(f"Unknown setting '{name}'.{did_you_mean(name, known)} Existing: {listing(known, 20)}.")
        values[name] = _READ[name](value) if name in _READ and value is not None else value
    return AnalysisSettings(**values)


def _numbers(value: int | Sequence[int]) -> tuple[int, ...]:
    items = [value] if isinstance(value, (int, str)) else list(value)
    try:
        return tuple(int(item) for item in items)
    except (TypeError, ValueError):
        raise BadArgument(f"Cannot use {value!r} as numbers; expected a whole number or several.") from None


def _words(value: int | str | Sequence[int | str]) -> tuple[str, ...]:
    items: Sequence[int | str] = [value] if isinstance(value, (int, str)) else list(value)
    return tuple(str(item) for item in items)


def _groups(value: Mapping[str, str | Sequence[str]] | Sequence[str]) -> tuple[str, ...]:
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, Mapping):
        return tuple(value)
    return tuple(f"{name}={_union(selectors)}" for name, selectors in value.items())


def _union(selectors: str | Sequence[str]) -> str:
    return selectors if isinstance(selectors, str) else " | ".join(f"({selector})" for selector in selectors)


def _ratio(value: str | tuple[str | Sequence[str], str | Sequence[str]]) -> str:
    if isinstance(value, str):
        return value
    if len(value) != 2:
        raise BadArgument(f"Cannot use {value!r} as a ratio; expected 'A,B/C' or a pair (numerator, denominator).")
    return "/".join(side if isinstance(side, str) else ",".join(side) for side in value)


_READ: dict[str, Any] = {
    "grouping": str, "groups": _groups, "ratio": _ratio, "layers": _numbers, "heads": _numbers, "tasks": _numbers, "denoise": _words,
}  # fmt: skip
