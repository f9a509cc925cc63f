"""Write the results file: from the table of replans to `attention_ratio_results_<suite>.json`."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.frames import EPISODE_KEYS, LAYERS_AVG, Tables, float_values
from vla_attention.analyze.measures.masses import ratio, sides
from vla_attention.analyze.show.output_files import replacing
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


def episode_documents(
    replans: Tables,
    grouping: Grouping,
    denoise_steps: Sequence[int],
    proxy: FrameProxy | None = None,
    num_keys: Iterable[NDArray[np.float64]] | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Episodes of one or more suites from `aggregate.replan_tables`, in their order: suite and JSON document.

    visual is the sum of the ratio's numerator groups, linguistic that of its denominator groups; the fraction of either
    is its mass / sum of all groups' masses. `denoise_steps` are those that the masses are means over. With a `proxy`
    the numbers are those of the published Cosmos scripts instead: masses are sums over the queries (ours are means),
    and fractions are of visual + linguistic only. `num_keys` (..., group) are the groups' numbers of keys in all
    episodes, taken from the tables unless they are given.

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
    # Numbers of keys are whole numbers in all episodes or in none.
    counts = (part.values("keys") for part in replans.parts) if num_keys is None else num_keys
    whole = _whole(counts, grouping)
    extra = {} if proxy is None else proxy.fields()
    # A few episodes at a time: tables of groups, and the documents, are several times as large as the cells.
    tables = (_with_sides(part, grouping, proxy).select(*EPISODE_KEYS, *columns) for part in replans.parts)
    counted = (table.with_columns(pl.col(whole).cast(pl.Int64)) for table in tables)
    of_episodes = (table.partition_by("suite", "task_id", "episode_index", maintain_order=True) for table in counted)
    for part in itertools.chain.from_iterable(of_episodes):
        identity = part.select(EPISODE_KEYS).row(0, named=True)
        summaries = {row["layer"]: row for row in _summaries(part, kinds).iter_rows(named=True)}
        in_time = part.sort("replan", maintain_order=True).drop(*EPISODE_KEYS, "replan")
        layers = in_time.partition_by("layer", as_dict=True, maintain_order=True, include_key=False)
        steps = {str(layer): rows for (layer,), rows in layers.items()}
        yield (
            identity["suite"],
            {
                "task_id": identity["task_id"],
                "episode_idx": identity["episode_index"],
                "task_description": identity["instruction"],
                "success": identity["success"],
                # The first replan comes after the last waiting step.
                "num_steps": loop_counter(
                    int(part["step"].to_numpy().min()), identity["num_steps"], identity["success"]
                ),
                "num_steps_definition": "loop_counter",
                "grouping": grouping.name,
                "grouping_description": grouping.description,
                "denoise_steps": list(denoise_steps),
                "summary": {_field_of_layer(layer): _summary_document(summaries[layer], kinds) for layer in steps},
                "per_step_ratios": {
                    _field_of_layer(layer): [step | extra for step in rows.to_dicts()] if extra else rows.to_dicts()
                    for layer, rows in steps.items()
                },
            },
        )


def _whole(num_keys: Iterable[NDArray[np.float64]], grouping: Grouping) -> list[str]:
    """Of which sides all numbers of keys are whole."""
    of_sides = zip(_KEYS, zip(*(sides(keys, grouping) for keys in num_keys), strict=True), strict=True)
    return [name for name, arrays in of_sides if all((array == np.floor(array)).all() for array in arrays)]


@contextmanager
def results_file(path: Path) -> Iterator[Callable[[dict[str, Any]], object]]:
    """Yield a function that adds an episode to a results file: strict JSON, an episode a line, written atomically."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        separators = itertools.chain(["[\n"], itertools.repeat(",\n"))
        yield lambda episode: file.write(next(separators) + json.dumps(episode, allow_nan=False, ensure_ascii=False))
        file.write("\n]\n" if next(separators) == ",\n" else "[]\n")


def write_results_of_suites(
    folder: Path,
    replans: Tables,
    grouping: Grouping,
    denoise_steps: Sequence[int],
    proxy: FrameProxy | None = None,
    num_keys: Iterable[NDArray[np.float64]] | None = None,
) -> list[Path]:
    """Write `attention_ratio_results_<suite>.json` for every suite of the tables and return the paths.

    The arguments are those of `episode_documents`; `folder` is where the files go.
    """
    files: dict[str, Callable[[dict[str, Any]], object]] = {}
    with ExitStack() as opened:
        for suite, document in episode_documents(replans, grouping, denoise_steps, proxy, num_keys):
            if suite not in files:
                files[suite] = opened.enter_context(results_file(folder / results_file_name(suite)))
            files[suite](document)
    return [folder / results_file_name(suite) for suite in files]


def _with_sides(replans: Tables, grouping: Grouping, proxy: FrameProxy | None) -> pl.DataFrame:
    """Add step, ratio (null where it is not finite), masses, fractions and numbers of keys of the two sides."""
    replans = replans.kept()
    cells = replans.cells
    visual, linguistic = cells["numerator_mass"], cells["denominator_mass"]
    queries = 1 if proxy is None else proxy.num_queries
    total = visual + linguistic if proxy else pl.Series(replans.values("mass").sum(axis=1))
    above, below = sides(replans.values("keys"), grouping)
    # Their quotient is read as the ratio of uniform attention, which it is where all queries see the same keys.
    uniform = float_values(cells["uniform_ratio"])
    same = ~np.isfinite(uniform) | np.isclose(uniform, ratio(above, below), rtol=1e-5)
    above, below = (np.where(same, keys, np.nan) for keys in (above, below))
    table = cells.with_columns(
        pl.col("env_step").alias("step"),
        # Over layers the published mean of ratios.
        pl.when(pl.col("ratio_mean").is_finite()).then(pl.col("ratio_mean")).alias(_RATIO),
        (visual * queries).alias("visual_mass"),
        (linguistic * queries).alias("linguistic_mass"),
        (visual / total).fill_nan(None).alias("visual_fraction"),
        (linguistic / total).fill_nan(None).alias("linguistic_fraction"),
        (total * queries).alias("total_mass"),
        *(pl.Series(name, keys).fill_nan(None) for name, keys in zip(_KEYS, (above, below), strict=True)),
    )
    if _ACTION in grouping.names:
        of_action = replans.of_group(_ACTION)
        table = table.with_columns(
            of_action["mass"].alias(f"{_ACTION}_mass"), of_action["fraction"].alias(f"{_ACTION}_fraction")
        )
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
