"""The results file: from the table of replans to `attention_ratio_results_<suite>.json`, and back into objects."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import polars as pl

from analyze.aggregate import EPISODE_KEYS, LAYERS_AVG
from analyze.atomic_file import replacing
from analyze.statistics import summarize
from schemas.grouping import Grouping
from schemas.jsonable import MalformedDocument, from_json, to_json
from schemas.results import (
    EpisodeResult,
    LayerSummary,
    MeanStd,
    RatioSummary,
    ResultsError,
    ResultsNotFound,
    StepRatio,
    results_file_name,
)

#: Fields that are absent, not null, when the grouping has no group of this name.
_ACTION = "action"
_ACTION_FIELDS = ("action_mass", "action_fraction")


def episode_results(replans: pl.DataFrame, grouping: Grouping) -> list[EpisodeResult]:
    """Episodes of one or more suites from the table of replans (`aggregate.add_layers_avg`), in its order.

    visual is the sum of the ratio's numerator groups, linguistic that of its denominator groups; the fraction of either is
    its mass / sum of all groups' masses.
    """
    if grouping.ratio is None:
        raise ResultsError(
            f"Grouping '{grouping.name}' defines no ratio, so there is no visual/linguistic ratio to write into a results "
            "file; expected a [ratio] with numerator and denominator groups (or --ratio A,B/C)."
        )
    table = _with_sides(replans, grouping)
    keys = list(EPISODE_KEYS)
    episodes = []
    for part in table.partition_by("suite", "task_id", "episode_index", maintain_order=True):
        identity = part.select(keys).row(0, named=True)
        layers = {
            LAYERS_AVG if layer == LAYERS_AVG else f"layer_{layer}": rows.sort("replan")
            for (layer,), rows in part.partition_by("layer", as_dict=True, maintain_order=True).items()
        }
        episodes.append(
            EpisodeResult(
                task_id=identity["task_id"],
                episode_idx=identity["episode_index"],
                task_description=identity["instruction"],
                success=identity["success"],
                num_steps=identity["num_steps"],
                summary={name: _summary(rows) for name, rows in layers.items()},
                per_step_ratios={
                    name: [StepRatio(**row) for row in _steps(rows).iter_rows(named=True)]
                    for name, rows in layers.items()
                },
            )
        )
    return episodes


def write_results(path: Path, episodes: Iterable[EpisodeResult]) -> None:
    """Write a results file atomically, as strict JSON with one episode per line."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        separator = "[\n"
        for episode in episodes:
            # One C-encoded line per episode: a suite with all layers has hundreds of thousands of steps.
            file.write(separator + json.dumps(_without_absent(to_json(episode)), allow_nan=False, ensure_ascii=False))
            separator = ",\n"
        file.write("\n]\n" if separator == ",\n" else "[]\n")


def write_results_of_suites(folder: Path, replans: pl.DataFrame, grouping: Grouping) -> list[Path]:
    """Write `attention_ratio_results_<suite>.json` for every suite of the table and return the paths."""
    paths = []
    for (suite,), part in replans.partition_by("suite", as_dict=True, maintain_order=True).items():
        path = folder / results_file_name(str(suite))
        write_results(path, episode_results(part, grouping))
        paths.append(path)
    return paths


def read_results(path: Path) -> list[EpisodeResult]:
    """Read a results file that this tool wrote; strict, and every error names the file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ResultsNotFound(f"Cannot read results file {path}: {error}.") from None
    try:
        return from_json(list[EpisodeResult], json.loads(text, parse_constant=_refuse_constant))
    except json.JSONDecodeError as error:
        raise ResultsError(f"Results file {path} is not valid JSON: {error}.") from None
    except (MalformedDocument, ResultsError) as error:
        raise ResultsError(f"Results file {path}: {error}") from None


def _refuse_constant(constant: str) -> NoReturn:
    raise ResultsError(
        f"it holds {constant}, which JSON does not have; files of the published scripts do, files of this tool write null."
    )


def _with_sides(replans: pl.DataFrame, grouping: Grouping) -> pl.DataFrame:
    assert grouping.ratio is not None
    total = pl.sum_horizontal(f"{name}_mass" for name in grouping.names)
    visual = pl.sum_horizontal(f"{name}_mass" for name in grouping.ratio.numerator)
    linguistic = pl.sum_horizontal(f"{name}_mass" for name in grouping.ratio.denominator)
    sides = [
        pl.col("env_step").alias("step"),
        pl.when(pl.col("ratio").is_finite()).then(pl.col("ratio")).alias("visual_linguistic_ratio"),
        visual.alias("visual_mass"),
        linguistic.alias("linguistic_mass"),
        (visual / total).fill_nan(None).alias("visual_fraction"),
        (linguistic / total).fill_nan(None).alias("linguistic_fraction"),
    ]
    action = list(_ACTION_FIELDS) if _ACTION in grouping.names else []
    return replans.select(*EPISODE_KEYS, "layer", "replan", *sides, *action)


def _steps(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.drop(*EPISODE_KEYS, "layer", "replan")


def _summary(rows: pl.DataFrame) -> LayerSummary:
    ratio = summarize(_values(rows, "visual_linguistic_ratio"))
    return LayerSummary(
        visual_linguistic_ratio=RatioSummary(
            ratio.mean, ratio.std, ratio.median, ratio.min, ratio.max, ratio.num_nonfinite
        ),
        visual_mass=_mean_std(rows, "visual_mass"),
        linguistic_mass=_mean_std(rows, "linguistic_mass"),
        visual_fraction=_mean_std(rows, "visual_fraction"),
        linguistic_fraction=_mean_std(rows, "linguistic_fraction"),
        num_steps=rows.height,
        **{field: _mean_std(rows, field) for field in _ACTION_FIELDS if field in rows.columns},
    )


def _mean_std(rows: pl.DataFrame, column: str) -> MeanStd:
    summary = summarize(_values(rows, column))
    return MeanStd(summary.mean, summary.std)


def _values(rows: pl.DataFrame, column: str) -> Any:
    return rows[column].fill_null(float("nan")).to_numpy()


def _without_absent(episode: dict[str, Any]) -> dict[str, Any]:
    """Drop the action fields of a grouping without such a group: the published files lack them rather than hold null."""
    for layer in episode["summary"].values():
        _drop_action(layer)
    for steps in episode["per_step_ratios"].values():
        for step in steps:
            _drop_action(step)
    return episode


def _drop_action(record: dict[str, Any]) -> None:
    # The mass decides: a fraction may be null although there is such a group (when every mass is 0).
    if record["action_mass"] is None:
        for field in _ACTION_FIELDS:
            del record[field]
