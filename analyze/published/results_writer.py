"""Write the results file of the published scripts, `attention_ratio_results_<suite>.json`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from vla_attention.analyze.core.levels import SIDES, Levels, replan_cells
from vla_attention.analyze.core.measure import Measured, means
from vla_attention.analyze.measures.tables import EPISODE_ID, LAYERS_AVG
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.selector_parser import Atom, parse_selector
from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.results import FrameProxy, ResultsError, loop_counter, results_file_name
from vla_attention.schemas.stores.store_format import RootAttributes

#: Fields that are absent, not null, when the grouping has no group of this name.
_ACTION = "action"
_SIDES = ("visual", "linguistic")
_RATIO = "visual_linguistic_ratio"
#: Numbers of keys on the two sides.
_KEYS = ("num_visual_tokens", "num_text_tokens")


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
    """The JSON document of each episode of a suite (its positions), by task and number; one is in memory at a time.

    visual is the sum of the ratio's numerator groups, linguistic that of its denominator groups; the fraction of either
    is its mass / sum of all groups' masses. `denoise_steps` are those that the masses are means over. With a `proxy`
    the numbers are those of the published Cosmos scripts instead: masses are sums over the queries (ours are means),
    and fractions are of visual + linguistic only. Numbers of keys that are whole in all episodes are whole numbers.

    The documents follow `vla_attention.schemas.results.EpisodeResult`. They are plain dictionaries, because a suite has
    a hundred thousand steps.
    """
    if grouping.ratio is None:
        raise ResultsError(
            f"Grouping '{grouping.name}' defines no ratio, so there is no visual/linguistic ratio to write into a "
            "results file; expected a [ratio] with numerator and denominator groups (or --ratio A,B/C)."
        )
    first = len(grouping.names)  # behind the groups, both sides of the ratio
    order, whole = [], set(_KEYS)
    for i in positions:
        one = measured[i]
        order.append((one.item.key, i))
        whole -= {name for k, name in enumerate(_KEYS) if (one.keys[:, first + k] % 1).any()}
    sides = [*_SIDES, _ACTION] if _ACTION in grouping.names and proxy is None else list(_SIDES)
    kinds = [f"{side}_{kind}" for side in sides for kind in ("mass", "fraction")]
    ratio = pl.col(_RATIO)
    spread = pl.struct(
        mean=ratio.mean(), std=ratio.std(ddof=0), median=ratio.median(), min=ratio.min(), max=ratio.max(),
        num_nonfinite=ratio.null_count(),
    )  # fmt: skip
    others = [pl.struct(mean=pl.col(kind).mean(), std=pl.col(kind).std(ddof=0)).alias(kind) for kind in kinds]
    for _, i in sorted(order):
        rows = _with_sides(measured[i], grouping, proxy)
        identity = rows.row(0, named=True)
        rows = rows.sort("replan", maintain_order=True).select("layer", "step", _RATIO, *kinds, "total_mass", *_KEYS)
        rows = rows.with_columns(pl.col([*whole]).cast(pl.Int64))
        summaries = rows.group_by("layer").agg(spread.alias(_RATIO), *others, num_steps=pl.len())
        of_layers = {row.pop("layer"): row for row in summaries.to_dicts()}
        layers = rows.partition_by("layer", as_dict=True, maintain_order=True, include_key=False)
        steps = {layer: part.to_dicts() for (layer,), part in layers.items()}
        names = {layer: layer if layer == LAYERS_AVG else f"layer_{layer}" for layer in steps}
        extra = {} if proxy is None else proxy.fields()
        yield {
            "task_id": identity["task_id"],
            "episode_idx": identity["episode_index"],
            "task_description": identity["instruction"],
            "success": identity["success"],
            # The first replan comes after the last waiting step.
            "num_steps": loop_counter(int(rows["step"].to_numpy().min()), identity["num_steps"], identity["success"]),
            "num_steps_definition": "loop_counter",
            "grouping": grouping.name,
            "grouping_description": grouping.description,
            "denoise_steps": list(denoise_steps),
            "summary": {names[layer]: of_layers[layer] for layer in steps},
            "per_step_ratios": {names[layer]: [step | extra for step in steps[layer]] for layer in steps},
        }


def write_results(path: Path, documents: Iterable[dict[str, Any]]) -> None:
    """Write a results file: strict JSON, an episode a line."""
    with path.open("w", encoding="utf-8") as file:
        separators = itertools.chain(["[\n"], itertools.repeat(",\n"))
        for document in documents:
            file.write(next(separators) + json.dumps(document, allow_nan=False, ensure_ascii=False))
        file.write("\n]\n" if next(separators) == ",\n" else "[]\n")


def _with_sides(one: Measured, grouping: Grouping, proxy: FrameProxy | None) -> pl.DataFrame:
    """The cells of replans with step, ratio (null where it is not finite), masses, fractions and numbers of keys."""
    on, rows = [*EPISODE_ID, "replan", "layer"], means(one, ("replan", "layer"), ("whole",))
    keys = rows.filter(pl.col("kind").is_in(SIDES)).pivot("kind", index=[*on, "whole"], values="keys")
    table = replan_cells(one, grouping).join(keys, on=on, maintain_order="left")
    if _ACTION in grouping.names:
        of_action = rows.filter(kind="group", group=_ACTION)
        named = of_action.select(*on, pl.col("mass").alias("action_mass"), pl.col("share").alias("action_fraction"))
        table = table.join(named, on=on, maintain_order="left")
    queries = 1 if proxy is None else proxy.num_queries
    visual, linguistic = pl.col("numerator_mass"), pl.col("denominator_mass")
    total = visual + linguistic if proxy else pl.col("whole")
    # The quotient of keys is read as the ratio of uniform attention, which it is where all queries see the same keys.
    of_keys, uniform = pl.col(SIDES[0]) / pl.col(SIDES[1]), pl.col("uniform_ratio")
    close = (uniform - of_keys).abs() <= 1e-8 + 1e-5 * of_keys.abs()
    same = ~uniform.is_finite().fill_null(False) | close.fill_null(False)
    return table.with_columns(
        pl.col("env_step").alias("step"),
        # Over layers the published mean of ratios.
        pl.when(pl.col("ratio_mean").is_finite()).then(pl.col("ratio_mean")).alias(_RATIO),
        (visual * queries).alias("visual_mass"),
        (linguistic * queries).alias("linguistic_mass"),
        (visual / total).fill_nan(None).alias("visual_fraction"),
        (linguistic / total).fill_nan(None).alias("linguistic_fraction"),
        (total * queries).alias("total_mass"),
        *(pl.when(same).then(pl.col(side)).alias(name) for side, name in zip(SIDES, _KEYS, strict=True)),
    )


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
