"""Which patches move the action (`schemas.effects.EffectMap`): how far a map can be trusted, and what lies on what.

Of every measured policy call the strongest patches by first order were taken away one at a time, all queries without
them; sizes are of these exact calls alone. Its top tenth are the tenth of all patches with the largest of these sizes.
With s the sizes of the top tenth and c the part of each patch that a thing covers,

    the thing's part = Σ s·c / Σ s

and the Nuisance Mass Ratio of the top tenth, NMR@10 (arXiv 2605.00321), the part that is on neither the named things
nor the robot. Of the other patches some were drawn at random: Spearman's correlation of their first order with their
exact sizes, root mean square of the normalised actions as the first order is, says how far the order of the map can be
trusted. Sizes below those of an unchanged call are rounding, and left out of it.
"""

from __future__ import annotations

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import ActionUnits, BaseEpisode
from vla_attention.analyze.core.axes import with_families
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.naming import told_things
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


def patch_maps(question: Question, units: ActionUnits) -> pl.DataFrame:
    """One row per patch of every policy call with a map that shows a part of a picture; none where no store has a map.

    Returns:
        suite, task_id, episode_index, replan, patch (place on the map's axis), key; first_order (an order alone);
        exact, the first part of `units` without the patch, and exact_rms, of the normalised actions; floor, the same of
        an unchanged call: less is rounding; drawn: whether it was drawn at random; named, robot: the parts of the patch
        that what the sentence names and the robot cover, null where that is not known.
    """
    frames = [_patches(item, units) for item in question.selected if _map_of(item) is not None]
    return pl.concat(frames) if frames else pl.DataFrame(schema=_SCHEMA)


_SCHEMA = {"suite": pl.String, "task_id": pl.Int64, "episode_index": pl.Int64, "replan": pl.Int64, "patch": pl.Int64,
           "key": pl.Int64, "first_order": pl.Float64, "exact": pl.Float64, "exact_rms": pl.Float64,
           "floor": pl.Float64, "drawn": pl.Boolean, "named": pl.Float64, "robot": pl.Float64}  # fmt: skip


def _map_of(item: SelectedEpisode) -> EffectMap | None:
    effects = item.episode.attributes.effects
    return None if effects is None else effects.map


def _patches(item: SelectedEpisode, units: ActionUnits) -> pl.DataFrame:
    effects, one = item.episode.attributes.effects, _map_of(item)
    assert effects is not None
    assert one is not None
    first, (rows, patches) = item.episode.read(MAP).astype(np.float64), (len(one.replan), len(one.keys))
    exact, rms, drawn = (np.full((rows, patches), np.nan) for _ in range(3))
    if one.patch:
        row = np.searchsorted(one.replan, one.patch_replan)
        normalised = item.episode.read(PATCH_CHANGE).astype(np.float64)
        at = BaseEpisode.of(item).at(np.array(one.patch_replan, np.int64))
        exact[row, one.patch] = units.changes(at, at.actions + normalised * np.array(effects.units))[:, 0]
        rms[row, one.patch] = np.sqrt((normalised[:, : one.steps] ** 2).mean(axis=(1, 2)))
        drawn[row, one.patch] = one.drawn
    named, robot = _covered(item, one)
    floor = np.repeat(_floor(item, one)[:, None], patches, axis=1)
    roles = item.tokens.static_roles
    seen = (roles[np.minimum(one.replan, len(roles) - 1)][:, list(one.keys)] == Role.IMAGE).ravel()
    columns = episode_columns(item, EPISODE_ID, rows * patches)
    values = {"first_order": first, "exact": exact, "exact_rms": rms, "floor": floor, "drawn": drawn,
              "named": named, "robot": robot}  # fmt: skip
    return (
        pl.DataFrame(
            {
                **columns,
                "replan": np.repeat(np.array(one.replan, np.int64), patches),
                "patch": np.tile(np.arange(patches), rows),
                "key": np.tile(np.array(one.keys, np.int64), rows),
                **{name: pl.Series(array.ravel(), nan_to_null=True) for name, array in values.items()},
            }
        )
        .with_columns(pl.col("drawn").cast(pl.Boolean))
        .filter(pl.Series(seen))
    )


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


def _covered(item: SelectedEpisode, one: EffectMap) -> tuple[Array, Array]:
    """The parts (row, patch) of each patch that the named things and the robot cover; NaN where that is not known."""
    unknown = np.full((len(one.replan), len(one.keys)), np.nan)
    named, coverage, layout = told_things(item), item.tokens.coverage, item.tokens.layout
    if named is None or not coverage:
        return unknown, unknown
    things = item.tokens.objects
    parts = []
    for chosen in ([thing.name in named for thing in things], [thing.kind == "robot" for thing in things]):
        of_keys = np.full((item.tokens.num_replans, layout.num_keys), np.nan)
        for camera, shares in coverage.items():
            of_keys[:, layout.patch_keys(camera)] = shares[..., chosen].sum(axis=-1)
        parts.append(of_keys[np.array(one.replan)][:, list(one.keys)])
    return parts[0], parts[1]


def episodes_of_maps(patches: pl.DataFrame, question: Question) -> pl.DataFrame:
    """Means over the policy calls of every episode.

    Returns:
        suite, task_id, episode_index, family, num_calls; rank: of the patches that were drawn; named, robot, other: the
        parts of the top tenth; area_named, area_robot: those of the pictures.
    """
    groups = patches.group_by([*EPISODE_ID, "replan"], maintain_order=True)
    calls = pl.DataFrame([_of_call(call) for _, call in groups], schema=_OF_CALL)
    means = pl.mean("rank", *_SHARES)
    episodes = calls.group_by(EPISODE_ID, maintain_order=True).agg(means, num_calls=pl.len())
    return with_families(episodes, question.sampling)


#: Parts of the size of the top patches, and of the pictures.
_SHARES = ("named", "robot", "other", "area_named", "area_robot")
_OF_CALL = {name: _SCHEMA[name] for name in EPISODE_ID} | dict.fromkeys(("rank", *_SHARES), pl.Float64)


def _of_call(call: pl.DataFrame) -> dict[str, object]:
    """The numbers of one policy call; None where it has them not."""
    drawn = call.filter(pl.col("drawn") & (pl.col("exact_rms") > pl.col("floor")))
    found: dict[str, object] = {name: call[name][0] for name in EPISODE_ID}
    if drawn.height >= _FEWEST_DRAWN:
        found["rank"] = drawn.select(pl.corr("first_order", "exact_rms", method="spearman").fill_nan(None)).item()
    strongest = call.drop_nulls("exact").filter(~pl.col("drawn")).sort("exact", descending=True)
    top = strongest.head(max(1, round(TOP * call.height)))
    whole = float(top["exact"].sum())
    if not whole or top["named"].null_count():
        return found
    named, robot = (float((top["exact"] * top[name]).sum()) / whole for name in ("named", "robot"))
    areas = {f"area_{name}": call[name].mean() for name in ("named", "robot")}
    return found | {"named": named, "robot": robot, "other": max(0.0, 1.0 - named - robot)} | areas


def summary_of_maps(episodes: pl.DataFrame, question: Question) -> pl.DataFrame:
    """One row: rank, named, robot, other, area_named, area_robot with their intervals; see `estimate`."""
    scales: dict[str, Scale] = {"rank": "correlation", **dict.fromkeys(_SHARES, "share")}
    return estimate(episodes.with_columns(all=pl.lit("")), ["all"], scales, question.sampling).drop("all")
