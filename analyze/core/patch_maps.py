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

from collections.abc import Collection

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


def patch_maps(question: Question, units: ActionUnits, first: bool = False) -> pl.DataFrame:
    """One row per block of every policy call with a map at the question's site that shows a part of a picture.

    first: only of the first call of each episode.

    Returns:
        suite, task_id, episode_index, success, replan, way (of `MapWay`), patch (place on the map's axis), key (the
        first of the block's), num_keys; first_order (an order alone; null in other maps); exact, the first part of
        `units` without it, and exact_rms, of the normalised actions; floor, the same of an unchanged call: less is
        rounding; noise: as exact, by another noise seed; drawn: whether it was drawn at random; attention: of the
        action queries to its keys; named, robot: the parts of it that what the sentence names and the robot cover, null
        where that is not known.
    """
    frames = [_patches(question, item, one, units) for item in question.selected
              if (one := map_of(item)) is not None and one.site == question.site]  # fmt: skip
    frames = [one.filter(replan=0) for one in frames] if first else frames
    return pl.concat(frames) if frames else pl.DataFrame()


def _patches(question: Question, item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> pl.DataFrame:
    effects = item.episode.attributes.effects
    assert effects is not None
    rows, patches = len(one.replan), one.num_blocks
    rms, drawn = (np.full((rows, patches), np.nan) for _ in range(2))
    exact, noise = exact_changes(item, one, units), _other_noise(item, one, units)
    if one.entries:
        of, patch, at_random = map(list, zip(*one.entries, strict=True))
        row = np.searchsorted(one.replan, of)
        normalised = item.episode.read(PATCH_CHANGE).astype(np.float64)
        rms[row, patch] = np.sqrt((normalised[:, : one.steps] ** 2).mean(axis=(1, 2)))
        drawn[row, patch] = at_random
    first = item.episode.read(MAP).astype(np.float64) if one.way == "first order" else np.full_like(exact, np.nan)
    block = np.array(one.blocks or range(patches))
    keys, number = np.array(one.keys), np.bincount(block)
    # Of every block the sum over its keys: (..., key) @ (key, block).
    of_block = np.zeros((len(keys), patches))
    of_block[np.arange(len(keys)), block] = 1.0
    calls = np.array(one.replan)
    roles = item.tokens.static_roles
    seen = ((roles[np.minimum(calls, len(roles) - 1)][:, keys] == Role.IMAGE) @ of_block > 0).ravel()
    values = {"first_order": first, "exact": exact, "exact_rms": rms, "drawn": drawn,
              "floor": np.repeat(_floor(item, one)[:, None], patches, axis=1),
              "noise": np.repeat(noise[:, None], patches, axis=1),
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
                "key": np.tile(keys[np.unique(block, return_index=True)[1]], rows),
                "num_keys": np.tile(number, rows),
                **{name: pl.Series(array.ravel(), nan_to_null=True) for name, array in values.items()},
            }
        )
        .with_columns(pl.col("drawn").cast(pl.Boolean))
        .filter(pl.Series(seen))
    )


def exact_changes(item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> Array:
    """The exact change without each block, first part of `units`, (map row, block); NaN where no call was made."""
    effects, found = item.episode.attributes.effects, np.full((len(one.replan), one.num_blocks), np.nan)
    assert effects is not None
    if one.entries:
        of, patch, _ = zip(*one.entries, strict=True)
        at = BaseEpisode.of(item).at(np.array(of, np.int64))
        change = item.episode.read(PATCH_CHANGE).astype(np.float64) * np.array(effects.units)
        found[np.searchsorted(one.replan, of), list(patch)] = units.changes(at, at.actions + change)[:, 0]
    return found


def _other_noise(item: SelectedEpisode, one: EffectMap, units: ActionUnits) -> Array:
    """The change by another noise seed, (map row,), as `exact_changes`."""
    effects, found = item.episode.attributes.effects, np.full(len(one.replan), np.nan)
    assert effects is not None
    entries = [
        i for i, (replan, number) in enumerate(zip(effects.replan, effects.condition, strict=True))
        if effects.items[number].change == "noise" and replan in one.replan
    ]  # fmt: skip
    if entries:
        of = np.array(effects.replan)[entries]
        at = BaseEpisode.of(item).at(of.astype(np.int64))
        change = item.episode.read(CHANGE)[entries].astype(np.float64) * np.array(effects.units)
        found[np.searchsorted(one.replan, of)] = units.changes(at, at.actions + change)[:, 0]
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


def named_in_maps(question: Question, patches: pl.DataFrame) -> Naming:
    """Named against not named, as `core.naming`: of each object its part of the sizes, in maps of blocks."""
    first = patches.filter(pl.col("way") != "first order", replan=0).partition_by(EPISODE_ID, as_dict=True)
    rows = []
    for item in question.selected:
        one, call, cover = map_of(item), first.get(item.key), _coverage(item, slice(1))
        if one is None or call is None or cover is None or call["exact"].null_count():
            continue
        sizes = np.zeros(one.num_blocks)
        sizes[call["patch"]] = call["exact"] * (call["exact_rms"] > call["floor"])
        of_key = (sizes / np.bincount(one.blocks))[list(one.blocks)]
        parts = of_key @ cover[0, list(one.keys)] / max(sizes.sum(), np.finfo(float).tiny)
        rows += [
            (*item.key, thing.name, ALL_CAMERAS, float(np.log(part)))
            for thing, part in zip(item.tokens.objects, parts, strict=True)
            if part > 0
        ]
    schema = {name: patches.schema[name] for name in EPISODE_ID}
    schema |= {"item": pl.String(), "camera": pl.String(), "x": pl.Float64()}
    return in_same_states(question, pl.DataFrame(rows, schema, orient="row"))
