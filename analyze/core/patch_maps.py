"""Which patches move the action (`schemas.effects.EffectMap`): how far a map can be trusted, and what lies on what.

Sizes are of exact calls without a patch, or a block of them, alone. Of a map by first order only the strongest were
made: its top tenth are the tenth of all patches with the largest of these sizes. Of a map of blocks all were. With s
the sizes of the top tenth, or of all blocks, and c the part of each that a thing covers,

    the thing's part = Σ s·c / Σ s

and the Nuisance Mass Ratio of the top tenth, NMR@10 (after arXiv 2605.00321), the part that is on neither the named
things nor the robot. Beside each stands the same sum over attention, of its own top tenth or of all, and Σ c² / Σ c:
the named things' part if their patches alone moved the action, each by what it shows of them, since blocks are larger
than things. Sizes below those of an unchanged call are rounding, and count as 0.

Of a map by first order some of the other patches were drawn at random: Spearman's correlation of their first order with
their exact sizes, root mean square of the normalised actions as the first order is, says how far the order of the map
can be trusted.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import ActionUnits, BaseEpisode
from vla_attention.analyze.core.axes import columns_of, with_families
from vla_attention.analyze.core.camera_maps import mean_rows
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.naming import Naming, in_same_states, told_things
from vla_attention.analyze.core.object_shares import ALL_CAMERAS
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.measures.tables import EPISODE_ID, episode_columns
from vla_attention.schemas.effects import CHANGE, MAP, PATCH_CHANGE, EffectMap
from vla_attention.schemas.layout import Role

Array = NDArray[np.float64]
#: The part of the patches that is the top, and the lowest correlation that a map needs at the end of its interval.
TOP, TRUSTED = 0.1, 0.5
#: With fewer patches above rounding, their order says nothing.
_FEWEST_DRAWN = 4
#: Columns of `patch_maps` that are of things.
_THINGS = ("named", "robot")


def any_map(question: Question) -> bool:
    """Whether a selected episode holds a map."""
    return any(map_of(item) is not None for item in question.selected)


def map_of(item: SelectedEpisode) -> EffectMap | None:
    """The map of an episode; None without one."""
    effects = item.episode.attributes.effects
    return None if effects is None else effects.map


def map_at_site(item: SelectedEpisode) -> EffectMap | None:
    """The map of an episode, if it is of the site whose tokens it was selected with."""
    one = map_of(item)
    return None if one is None or one.site != item.tokens.layout.name else one


def patch_maps(question: Question, units: ActionUnits) -> pl.DataFrame:
    """One row per block of every policy call with a map at the question's site that shows a part of a picture.

    Returns:
        suite, task_id, episode_index, success, replan, way (of `MapWay`), patch (place on the map's axis), key (the
        first of the block's), num_keys; first_order (an order alone; null in other maps); exact, the first part of
        `units` without it, and exact_rms, of the normalised actions; floor, the same of an unchanged call: less is
        rounding; noise: as exact, by another noise seed; drawn: whether it was drawn at random; attention: of the
        action queries to its keys; named, robot: the parts of it that what the sentence names and the robot cover, null
        where that is not known.
    """
    frames = [
        _patches(question, item, one, units) for item in question.selected if (one := map_at_site(item)) is not None
    ]
    return pl.concat(frames) if frames else pl.DataFrame()


def _patches(question: Question, item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> pl.DataFrame:
    rows, patches = len(one.replan), one.num_blocks
    exact, rms = exact_changes(item, one, units)
    drawn = np.full((rows, patches), np.nan)
    for replan, patch, at_random in one.entries:
        drawn[one.replan.index(replan), patch] = at_random
    first = item.episode.read(MAP).astype(np.float64) if one.way == "first order" else np.full_like(exact, np.nan)
    keys, calls, of_block = np.array(one.keys), np.array(one.replan), _of_block(one)
    number = of_block.sum(axis=0).astype(np.int64)
    values = {"first_order": first, "exact": exact, "exact_rms": rms, "drawn": drawn,
              "floor": np.repeat(_floor(item, one)[:, None], patches, axis=1),
              "noise": np.repeat(_other_noise(item, one, units)[:, None], patches, axis=1),
              "attention": mean_rows(question, item)[calls][:, keys] @ of_block}  # fmt: skip
    values |= {name: cover[calls][:, keys] @ of_block / number for name, cover in _covered(item).items()}
    columns = episode_columns(item, [*EPISODE_ID, "success"], rows * patches)
    return (
        pl.DataFrame(
            {
                **columns,
                "replan": np.repeat(calls.astype(np.int64), patches),
                "way": [one.way] * (rows * patches),
                "patch": np.tile(np.arange(patches), rows),
                "key": np.tile(keys[of_block.argmax(axis=0)], rows),
                "num_keys": np.tile(number, rows),
                **{name: pl.Series(array.ravel(), nan_to_null=True) for name, array in values.items()},
            }
        )
        .with_columns(pl.col("drawn").cast(pl.Boolean))
        .filter(pl.Series(_seen(item, one).ravel()))
    )


def _of_block(one: EffectMap) -> Array:
    """1 where a key is of a block, (key, block): (..., key) @ it is the sum over each block's keys."""
    found = np.zeros((len(one.keys), one.num_blocks))
    found[np.arange(len(one.keys)), np.array(one.blocks or range(one.num_blocks))] = 1.0
    return found


def _seen(item: SelectedEpisode, one: EffectMap) -> NDArray[np.bool_]:
    """Which blocks show a part of a picture, (map row, block)."""
    roles = item.tokens.static_roles
    is_image = roles[np.minimum(one.replan, len(roles) - 1)][:, list(one.keys)] == Role.IMAGE
    found: NDArray[np.bool_] = is_image @ _of_block(one) > 0
    return found


def exact_changes(item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> tuple[Array, Array]:
    """The exact change without each block, (map row, block) each; NaN where no call was made.

    Returns:
        in the first part of `units`; root mean square of the normalised actions.
    """
    sizes, rms = (np.full((len(one.replan), one.num_blocks), np.nan) for _ in range(2))
    if one.entries:
        replans, patches, _ = map(list, zip(*one.entries, strict=True))
        change = item.episode.read(PATCH_CHANGE).astype(np.float64)
        rows = np.searchsorted(one.replan, replans)
        sizes[rows, patches] = _in_units(item, replans, change, units)
        rms[rows, patches] = np.sqrt((change[:, : one.steps] ** 2).mean(axis=(1, 2)))
    return sizes, rms


def _in_units(item: SelectedEpisode, replans: Sequence[int], change: Array, units: ActionUnits) -> Array:
    """The first part of `units` of changes (entry, horizon, dimension) as stored, at these replans, (entry,)."""
    effects, at = item.episode.attributes.effects, BaseEpisode.of(item).at(np.array(replans, np.int64))
    assert effects is not None
    sizes: Array = units.changes(at, at.actions + change * np.array(effects.units))[:, 0]
    return sizes


def _other_noise(item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> Array:
    """The change by another noise seed, (map row,), as `exact_changes`."""
    effects, found = item.episode.attributes.effects, np.full(len(one.replan), np.nan)
    assert effects is not None
    entries = [
        i for i, (replan, number) in enumerate(zip(effects.replan, effects.condition, strict=True))
        if effects.items[number].change == "noise" and replan in one.replan
    ]  # fmt: skip
    if entries:
        replans = [effects.replan[i] for i in entries]
        change = item.episode.read(CHANGE)[entries].astype(np.float64)
        found[np.searchsorted(one.replan, replans)] = _in_units(item, replans, change, units)
    return found


def _floor(item: SelectedEpisode, one: EffectMap) -> Array:
    """How far an unchanged call among the changed ones is from the executed one, (row,), as `exact_rms`."""
    effects, found = item.episode.attributes.effects, np.zeros(len(one.replan))
    assert effects is not None
    unchanged = [i for i, condition in enumerate(effects.condition) if effects.items[condition].change == "nothing"]
    if unchanged:
        change = item.episode.read(CHANGE)[unchanged, : one.steps].astype(np.float64)
        of_replan = dict(zip(np.array(effects.replan)[unchanged], np.sqrt((change**2).mean(axis=(1, 2))), strict=True))
        found[:] = [of_replan.get(replan, 0.0) for replan in one.replan]
    return found


def _covered(item: SelectedEpisode) -> dict[str, Array]:
    """The parts (replan, key) of each patch that things cover, see `patch_maps`; NaN where that is not known."""
    things, named, each = item.tokens.objects, told_things(item), _coverage(item)
    if named is None or each is None:
        return dict.fromkeys(_THINGS, np.full((item.tokens.num_replans, item.tokens.layout.num_keys), np.nan))
    found = {"named": each[..., [thing.name in named for thing in things]].sum(axis=-1)}
    return found | {"robot": each[..., [thing.kind == "robot" for thing in things]].sum(axis=-1)}


def _coverage(item: SelectedEpisode, replans: slice = slice(None)) -> Array | None:
    """The part of each patch that each object covers, (replan, key, object), NaN beside patches; None: not known."""
    if not item.tokens.coverage:
        return None
    layout, number = item.tokens.layout, item.tokens.num_replans
    each = np.full((len(range(number)[replans]), layout.num_keys, len(item.tokens.objects)), np.nan)
    for camera, shares in item.tokens.coverage.items():
        each[:, layout.patch_keys(camera)] = shares[replans]
    return each


def calls_of_maps(patches: pl.DataFrame, question: Question) -> pl.DataFrame:
    """The numbers of every policy call.

    Returns:
        suite, task_id, episode_index, success, family, replan, way; rank: of the patches that were drawn; top_named,
        top_robot, top_other (NMR@10): the parts of the top tenth; all_named, ...: of all blocks, null by first order;
        the same of attention, as attention_top_named, ...; most_named: see the module; area_named, area_robot: of the
        pictures; median, noise: the median block's change, and that by another noise seed, in the first part of the
        units.
    """
    groups = patches.group_by([*EPISODE_ID, "replan", "way"], maintain_order=True)
    schema = {name: patches.schema[name] for name in (*EPISODE_ID, "success", "replan", "way")}
    schema |= dict.fromkeys(("rank", *SHARES, *_SIZES), pl.Float64())
    calls = pl.DataFrame([_of_call(call) for _, call in groups], schema=schema)
    return with_families(calls, question.sampling)


_PARTS = tuple(f"{which}_{thing}" for which in ("top", "all") for thing in (*_THINGS, "other"))
#: Parts of sizes, of attention, and of the pictures.
SHARES = (*_PARTS, *(f"attention_{name}" for name in _PARTS), "most_named", *(f"area_{name}" for name in _THINGS))
_SIZES = ("median", "noise")
#: A top tenth of fewer blocks says nothing.
_FEWEST_TOP = 4


def _of_call(call: pl.DataFrame) -> dict[str, object]:
    """The numbers of one policy call; None where it has them not."""
    found: dict[str, object] = {name: call[name][0] for name in (*EPISODE_ID, "success", "replan", "way")}
    drawn = call.filter(pl.col("drawn") & (pl.col("exact_rms") > pl.col("floor")))
    if drawn.height >= _FEWEST_DRAWN:
        found["rank"] = drawn.select(pl.corr("first_order", "exact_rms", method="spearman").fill_nan(None)).item()
    above = pl.when(pl.col("exact_rms") > pl.col("floor")).then("exact").otherwise(0.0)
    sized = call.drop_nulls("exact").filter(~pl.col("drawn")).with_columns(size=above)
    every = call["exact"].null_count() == 0
    found |= {"noise": call["noise"][0]} | ({"median": sized["size"].median()} if every else {})
    if call["named"].null_count():
        return found
    weights = call["num_keys"]
    found |= {f"area_{name}": float((call[name] * weights).sum()) / float(weights.sum()) for name in _THINGS}
    covers = call["named"].to_numpy()
    if covers.sum():
        found["most_named"] = float((covers**2).sum() / covers.sum())
    top, read = round(TOP * call.height), call.sort("attention", descending=True)
    if top >= _FEWEST_TOP or not every:
        top = max(1, top)
        found |= _parts(sized.sort("size", descending=True).head(top), "size", "top_")
        found |= _parts(read.head(top), "attention", "attention_top_")
    if every:
        found |= _parts(sized, "size", "all_") | _parts(read, "attention", "attention_all_")
    return found


def _parts(rows: pl.DataFrame, size: str, before: str) -> dict[str, object]:
    """The parts of a size that lie on what is named, the robot and neither; empty where it is 0."""
    whole = float(rows[size].sum())
    if not whole:
        return {}
    named, robot = (float((rows[size] * rows[name]).sum()) / whole for name in _THINGS)
    parts = {"named": named, "robot": robot, "other": max(0.0, 1.0 - named - robot)}
    return {f"{before}{name}": value for name, value in parts.items()}


def episodes_of_maps(calls: pl.DataFrame, by: Collection[str] = ()) -> pl.DataFrame:
    """Means over the policy calls of every episode, of each one where `by` has replan; see `calls_of_maps`."""
    keys = [*EPISODE_ID, "success", "family", "way", *(["replan"] if "replan" in by else [])]
    means = [pl.col(name).mean() for name in ("rank", *SHARES, *_SIZES)]
    return calls.group_by(keys, maintain_order=True).agg(means, num_calls=pl.len())


def summary_of_maps(episodes: pl.DataFrame, question: Question, by: Collection[str] = ()) -> pl.DataFrame:
    """One row for each way and what is kept apart: rank and `SHARES` with their intervals; see `estimate`."""
    scales: dict[str, Scale] = {"rank": "correlation", **dict.fromkeys(SHARES, "share"),
                                **dict.fromkeys(_SIZES, "positive")}  # fmt: skip
    kept = ["way", *(column.name for column in columns_of(by) if column.name in episodes.columns)]
    return estimate(episodes, kept, scales, question.sampling)


def named_in_maps(question: Question, units: ActionUnits) -> Naming:
    """Named against not named, as `core.naming`: of each object its part of the sizes, in maps of blocks."""
    rows = []
    for item in question.selected:
        one, cover = map_at_site(item), _coverage(item, slice(1))
        if one is None or one.way == "first order" or cover is None or 0 not in one.replan:
            continue
        first = one.replan.index(0)
        (exact, rms), seen = exact_changes(item, one, units), _seen(item, one)[first]
        if np.isnan(exact[first, seen]).any():
            continue
        sizes = np.where(seen & (rms[first] > _floor(item, one)[first]), exact[first], 0.0)
        of_key = (sizes / np.bincount(one.blocks))[list(one.blocks)]
        parts = of_key @ cover[0, list(one.keys)] / max(sizes.sum(), np.finfo(float).tiny)
        rows += [
            (*item.key, thing.name, ALL_CAMERAS, float(np.log(part)))
            for thing, part in zip(item.tokens.objects, parts, strict=True)
            if part > 0
        ]
    schema = {"suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "item": pl.String,
              "camera": pl.String, "x": pl.Float64}  # fmt: skip
    return in_same_states(question, pl.DataFrame(rows, schema, orient="row"))
