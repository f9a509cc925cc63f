"""Write the results file of the published scripts, `attention_ratio_results_<suite>.json`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from vla_attention.analyze.core.levels import MORE, SIDES, Levels, replan_cells
from vla_attention.analyze.core.measure import Measured, means
from vla_attention.analyze.measures.frames import EPISODE_ID, EPISODE_KEYS, LAYERS_AVG
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.selector_parser import Atom, parse_selector
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.results import FrameProxy, ResultsError, loop_counter, results_file_name
from vla_attention.schemas.stores.store_format import RootAttributes

#: Fields that are absent, not null, when the grouping has no group of this name.
_ACTION = "action"
_SIDES = ("visual", "linguistic")
_RATIO = "visual_linguistic_ratio"
#: Fields of every step beside ratio, masses and fractions.
_KEYS = ("num_visual_tokens", "num_text_tokens")
_COUNTS = ("total_mass", *_KEYS)


def results_files(levels: Levels) -> dict[str, Callable[[Path], None]]:
    """The results file of every suite by its name; each writes itself to a path. The grouping has a ratio."""
    question, grouping = levels.question, levels.grouping
    proxy = frame_proxy(question.stores[0].attributes, question.selected[0].tokens.layout, grouping)

    def write(path: Path, suite: str) -> None:
        positions = [i for i, item in enumerate(question.selected) if item.store.suite == suite]
        write_results(path, documents_of(levels.measured, positions, grouping, question.selection.denoise_steps, proxy))

    suites = dict.fromkeys(item.store.suite for item in question.selected)
    return {results_file_name(suite): partial(write, suite=suite) for suite in suites}


def documents_of(
    measured: Sequence[Measured],
    positions: Sequence[int],
    grouping: Grouping,
    denoise_steps: Sequence[int],
    proxy: FrameProxy | None = None,
) -> Iterator[dict[str, Any]]:
    """`episode_documents` of the episodes of a suite, by task and number; one of them is in memory at a time."""
    first = len(grouping.names)  # behind the groups, both sides of the ratio
    whole, order = set(_KEYS), []
    for i in positions:
        one = measured[i]
        order.append((one.item.key, i))
        whole -= {name for k, name in enumerate(_KEYS) if (one.keys[:, first + k] % 1).any()}
    rows = (means(measured[i], ("replan", "layer"), (*MORE, "whole")) for _, i in sorted(order))
    return episode_documents(rows, grouping, denoise_steps, proxy, whole)


def episode_documents(
    episodes: Iterable[pl.DataFrame],
    grouping: Grouping,
    denoise_steps: Sequence[int],
    proxy: FrameProxy | None = None,
    whole: Collection[str] = _KEYS,
) -> Iterator[dict[str, Any]]:
    """The JSON document of each episode.

    visual is the sum of the ratio's numerator groups, linguistic that of its denominator groups; the fraction of either
    is its mass / sum of all groups' masses. `denoise_steps` are those that the masses are means over. With a `proxy`
    the numbers are those of the published Cosmos scripts instead: masses are sums over the queries (ours are means),
    and fractions are of visual + linguistic only. `whole`: which numbers of keys are whole in all episodes.

    Args:
        episodes: the rows of `core.measure.means` of one episode each, by replan and layer, with `levels.MORE` and the
            mass of all groups.

    The documents follow `vla_attention.schemas.results.EpisodeResult`. They are plain dictionaries, because a suite has
    a hundred thousand steps.
    """
    if grouping.ratio is None:
        raise ResultsError(
            f"Grouping '{grouping.name}' defines no ratio, so there is no visual/linguistic ratio to write into a "
            "results file; expected a [ratio] with numerator and denominator groups (or --ratio A,B/C)."
        )
    sides = [*_SIDES, _ACTION] if _ACTION in grouping.names and proxy is None else list(_SIDES)
    kinds = [f"{side}_{kind}" for side in sides for kind in ("mass", "fraction")]
    columns = ("layer", "replan", "step", _RATIO, *kinds, *_COUNTS)
    extra = {} if proxy is None else proxy.fields()
    for rows in episodes:
        part = _with_sides(rows, grouping, proxy).select(*EPISODE_KEYS, *columns)
        part = part.with_columns(pl.col(name).cast(pl.Int64) for name in whole)
        identity = part.select(EPISODE_KEYS).row(0, named=True)
        summaries = {row["layer"]: row for row in _summaries(part, kinds).iter_rows(named=True)}
        in_time = part.sort("replan", maintain_order=True).drop(*EPISODE_KEYS, "replan")
        layers = in_time.partition_by("layer", as_dict=True, maintain_order=True, include_key=False)
        steps = {str(layer): rows for (layer,), rows in layers.items()}
        yield {
            "task_id": identity["task_id"],
            "episode_idx": identity["episode_index"],
            "task_description": identity["instruction"],
            "success": identity["success"],
            # The first replan comes after the last waiting step.
            "num_steps": loop_counter(int(part["step"].to_numpy().min()), identity["num_steps"], identity["success"]),
            "num_steps_definition": "loop_counter",
            "grouping": grouping.name,
            "grouping_description": grouping.description,
            "denoise_steps": list(denoise_steps),
            "summary": {_field_of_layer(layer): _summary_document(summaries[layer], kinds) for layer in steps},
            "per_step_ratios": {
                _field_of_layer(layer): [step | extra for step in rows.to_dicts()] if extra else rows.to_dicts()
                for layer, rows in steps.items()
            },
        }


def write_results(path: Path, documents: Iterable[dict[str, Any]]) -> None:
    """Write a results file: strict JSON, an episode a line."""
    with path.open("w", encoding="utf-8") as file:
        separators = itertools.chain(["[\n"], itertools.repeat(",\n"))
        for document in documents:
            file.write(next(separators) + json.dumps(document, allow_nan=False, ensure_ascii=False))
        file.write("\n]\n" if next(separators) == ",\n" else "[]\n")


def _with_sides(rows: pl.DataFrame, grouping: Grouping, proxy: FrameProxy | None) -> pl.DataFrame:
    """Add step, ratio (null where it is not finite), masses, fractions and numbers of keys of the two sides."""
    on = [*EPISODE_ID, "replan", "layer"]
    cells = replan_cells(rows, grouping)
    for kind, name in zip(SIDES, _KEYS, strict=True):
        of_side = rows.filter(pl.col("kind") == kind).select(*on, "whole", pl.col("keys").alias(name))
        cells = cells.join(of_side.drop("whole") if "whole" in cells.columns else of_side, on=on, maintain_order="left")
    queries = 1 if proxy is None else proxy.num_queries
    visual, linguistic = pl.col("numerator_mass"), pl.col("denominator_mass")
    total = visual + linguistic if proxy else pl.col("whole")
    # Their quotient is read as the ratio of uniform attention, which it is where all queries see the same keys.
    of_keys, uniform = pl.col(_KEYS[0]) / pl.col(_KEYS[1]), pl.col("uniform_ratio")
    close = (uniform - of_keys).abs() <= 1e-8 + 1e-5 * of_keys.abs()
    same = ~uniform.is_finite().fill_null(False) | close.fill_null(False)
    table = cells.with_columns(
        pl.col("env_step").alias("step"),
        # Over layers the published mean of ratios.
        pl.when(pl.col("ratio_mean").is_finite()).then(pl.col("ratio_mean")).alias(_RATIO),
        (visual * queries).alias("visual_mass"),
        (linguistic * queries).alias("linguistic_mass"),
        (visual / total).fill_nan(None).alias("visual_fraction"),
        (linguistic / total).fill_nan(None).alias("linguistic_fraction"),
        (total * queries).alias("total_mass"),
        *(pl.when(same).then(pl.col(name)).alias(name) for name in _KEYS),
    )
    if _ACTION in grouping.names:
        of_action = rows.filter(pl.col("kind") == "group", pl.col("group") == _ACTION)
        named = of_action.select(*on, pl.col("mass").alias("action_mass"), pl.col("share").alias("action_fraction"))
        table = table.join(named, on=on, maintain_order="left")
    return table


def _summaries(episode: pl.DataFrame, kinds: Sequence[str]) -> pl.DataFrame:
    """One row per layer: number of steps, the finite ratios in five numbers, mean and std (ddof 0) of the others."""
    ratio = pl.col(_RATIO)
    spread = [ratio.mean(), ratio.std(ddof=0).alias("std"), ratio.median().alias("median")]
    ends = [ratio.min().alias("min"), ratio.max().alias("max"), ratio.null_count().alias("num_nonfinite")]
    others = [part for kind in kinds for part in (pl.col(kind).mean(), pl.col(kind).std(ddof=0).alias(f"{kind}_std"))]
    return episode.group_by("layer").agg(pl.len().alias("num_steps"), *spread, *ends, *others)


def _summary_document(row: dict[str, Any], kinds: Sequence[str]) -> dict[str, Any]:
    spread = {name: row[name] for name in ("std", "median", "min", "max", "num_nonfinite")}
    return {
        _RATIO: {"mean": row[_RATIO], **spread},
        **{kind: {"mean": row[kind], "std": row[f"{kind}_std"]} for kind in kinds},
        "num_steps": row["num_steps"],
    }


def _field_of_layer(layer: str) -> str:
    return layer if layer == LAYERS_AVG else f"layer_{layer}"


def frame_proxy(root: RootAttributes, layout: SiteLayout, grouping: Grouping) -> FrameProxy | None:
    """The published ratio that a grouping asks for: one `frame:` selector on each side, at the site of the latent
    frames.

    None for every other ratio.
    """
    if grouping.ratio is None or not any(span.kind == "latent" for span in layout.spans):
        return None
    visual, text = (_frame_of(grouping, side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
    query = root.policy.config.get("query_frame")
    if visual is None or text is None or not isinstance(query, str):
        return None
    return FrameProxy(layout.num_keys, query, visual, text, root.recording.of_site(layout).num_action_queries)


def _frame_of(grouping: Grouping, side: tuple[str, ...]) -> str | None:
    selectors = [selector for name in side for selector in grouping.groups[name]]
    if len(selectors) != 1:
        return None
    tree = parse_selector(selectors[0])
    return tree.argument if isinstance(tree, Atom) and tree.kind == "frame" else None
