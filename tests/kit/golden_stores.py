"""The golden stores, and the numbers that a store gives: its arrays, and tables of the analysis."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl

import vla_attention as va
from tests.kit.archives import unpacked
from tests.kit.paths import GOLDEN
from vla_attention.analyze.api import OpenStores
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import NUMBERS

FOLDER = GOLDEN / "stores"
#: joint: pi0.5 of test size. cosmos: sites `self` and `cross`. library: recorded by `va.record`. rerun: the policy
#: calls of `joint` without a camera. masks: queries, layers, heads, denoise steps and replans see different keys.
#: effects: the policy calls of `joint` again, with the effects of words and objects for all four readers. steps: made
#: up, with positions, touches and goals.
NAMES = ("joint", "cosmos", "library", "rerun", "masks", "effects", "steps")


def golden_store(name: str) -> Path:
    """A golden store, unpacked."""
    return unpacked(FOLDER / f"{name}.tar.xz")


#: Matrix products of other processors round otherwise; what is stored has to agree to the bit.
_RELATIVE, _OF_LOGARITHMS = 1e-5, 1e-6


def numbers_of(path: Path) -> dict[str, pl.DataFrame]:
    """Tables by name: the digests of what every array holds, and what the analysis makes of it."""
    run = va.open(path)
    tables = {"arrays": _arrays(path), "episodes": run.episodes.drop("store", strict=False)}
    for site in run.attributes.sites:
        asked = {"site": site.name, "grouping": "default"}
        tables |= {
            f"{site.name}_ratios": run.analyze(**asked)["tasks"],
            f"{site.name}_masses": run.analyze(**asked)["replans_groups"],
            **_heads(run, site.name, asked),
        }
    if run.stores[0].attributes.recording.effects is not None:
        kept = ["task_id", "episode_index", "condition", "num_replans", "effect", "effect_chunk", "keys", "lift"]
        rows = run.effects()["effects_episodes"].sort("task_id", "episode_index", "condition")
        tables["effects"] = rows.select(kept)
    return {name: table for name, table in tables.items() if table.width}


def _heads(run: OpenStores, site: str, asked: dict[str, Any]) -> dict[str, pl.DataFrame]:
    """Ratios and lifts of every head, as base 2 logarithms; nothing for a site without a ratio."""
    tables = {table.name: table for table in run.analyze(by=("layer", "head"), **asked).tables}
    if "by" not in tables:
        return {}
    rows = tables["by"].shown.drop("layer").rename({"layer_number": "layer"})
    logs = {"log2_ratio": "ratio", "log2_lift": "ratio_lift"}
    ends = ("", "_low", "_high")
    found = rows.with_columns(
        pl.col(f"{of}{end}").log(2.0).alias(f"{name}{end}") for name, of in logs.items() for end in ends
    )
    return {f"{site}_heads": found}


def _arrays(path: Path) -> pl.DataFrame:
    """A row for each array, and each list of numbers of the attributes: shape, type and sha256 of its values."""
    rows = []
    for episode in open_store(path).episodes:
        names = [*episode.attributes.arrays, *(name for name in NUMBERS if episode.has(name))]
        for name in sorted(names):
            values = episode.read(name)
            digest = hashlib.sha256(values.astype(values.dtype.newbyteorder("<")).tobytes()).hexdigest()
            rows.append((episode.name, name, str(values.shape), str(values.dtype), digest))
    return pl.DataFrame(rows, schema=["episode", "array", "shape", "type", "sha256"], orient="row")


def same(column: str, one: object, other: object) -> bool:
    """Whether two values are: floats to a hundred-thousandth, logarithms to a millionth, everything else exactly."""
    if isinstance(one, float) and isinstance(other, float):
        absolute = _OF_LOGARITHMS if column.startswith("log2") else 0
        return (math.isnan(one) and math.isnan(other)) or math.isclose(one, other, rel_tol=_RELATIVE, abs_tol=absolute)
    return one == other


def differences(
    found: pl.DataFrame, expected: pl.DataFrame, alike: Callable[[str, object, object], bool] = same
) -> list[str]:
    """Where a table differs from the one that was kept: its columns have to be there, with values that are alike.

    Columns that were added since are left out. The order of rows is that of their labels: where a table is sorted by
    numbers, last bits may change it.
    """
    found = found.select(name for name in expected.columns if name in found.columns)
    if found.columns != expected.columns or found.height != expected.height:
        return [f"{found.shape} with {found.columns}; expected {expected.shape} with {expected.columns}"]
    labels = [name for name, kind in expected.schema.items() if kind.is_integer() or kind in (pl.String, pl.Boolean)]
    found, expected = (table.sort(labels, maintain_order=True) if labels else table for table in (found, expected))
    return [
        f"row {row}, {name}: {one!r}; expected {other!r}"
        for name in found.columns
        for row, (one, other) in enumerate(zip(found[name].to_list(), expected[name].to_list(), strict=True))
        if not alike(name, one, other)
    ]


def write_tables(path: Path, folder: Path) -> None:
    """Write the numbers of a store as CSV files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in numbers_of(path).items():
        flat(table).write_csv(folder / f"{name}.csv")


def read_table(file: Path, like: pl.DataFrame) -> pl.DataFrame:
    """A table of `write_tables`, with the types of the one that it is compared with."""
    kept = pl.read_csv(file, n_rows=0).columns
    return pl.read_csv(file, schema={name: kind for name, kind in flat(like).schema.items() if name in kept})


def flat(table: pl.DataFrame) -> pl.DataFrame:
    """A table as a CSV file can hold it: lists as text."""
    nested = [name for name, kind in table.schema.items() if kind.is_nested()]
    return table.with_columns(pl.Series(name, [str(value) for value in table[name].to_list()]) for name in nested)
