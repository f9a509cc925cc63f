"""What keys add to the residual stream, from stored Gram matrices: of the pictures and the text, and of groups.

A mass measures how much attention keys get, not what they add. The contribution of a set of keys is a vector
(probabilities x values, through the output projection and gate; Kobayashi et al. 2020). The matrices are of whole
segments (a span's keys of one role), and contributions add up as vectors: the norm of a union of segments is
sqrt(wᵀ G w), root mean square over the action queries. A group that takes only a part of a segment (a word, a patch, an
object) has no norm. Unlike masses, norms of different sites are lengths in the same space.

The baseline. A part i of the keys (a segment) adds the vector c_i, which attention has weighted; its mass is m_i, the
mean over heads and queries. Uniform attention would give it the part s_i of what it gives all valid keys of the site
(`schemas/groupings/key_counts.py`; n_i / N where all queries see the same N keys), and it would then add about

    s_i / m_i * c_i

so that the norm of a side is sqrt(uᵀ G u) with u_i = s_i / m_i for its parts. For uniform attention this is the
norm itself, and lift = ratio / uniform ratio is 1. Between parts it is exact where attention is even inside each of
them. Otherwise the mean value of a part as attention weights it stands for the plain mean of its values, and the mean
over heads for each head: the store has no values of single keys. So the lift tells how attention is shared out between
parts, as that of masses does, while the uniform ratio tells what the values alone make of a ratio: how long and how
much of one direction they are. Unlike masses, both may be given for sides at different sites.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.lazy_frames import frame_of_episodes
from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.frames import (
    EPISODE_ID,
    LAYERS_AVG,
    denoise_axis,
    layer_axis,
    long_table,
    replan_axis,
)
from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.not_in_memory import MadeWhenAsked, OnDisk
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_episode
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.analyze.stores.parallel import each_episode, map_episodes
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import Segment, segment_members, weights_on_segments
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import RootAttributes

Array = NDArray[np.float64]
#: Roles of the keys on each side of the ratio: the images that the policy sees now, and the text.
VISUAL_ROLES = ("image",)
LINGUISTIC_ROLES = ("bos", "template", "instruction", "text")
_GEOMETRIC = {"geometric_mean": "contribution_ratio", "uniform_ratio": "uniform_ratio", "ratio_lift": "ratio_lift"}


@dataclass(frozen=True)
class Norms:
    """Norms of every episode, and the tables that are made of them.

    Attributes:
        measured: of each episode its tokens and arrays, whose axes `axes` labels.
        above, below: the columns of the ratio's sides; empty without a ratio.
        groups: the groups whose norms there are.
    """

    measured: Sequence[tuple[SelectedEpisode, Mapping[str, NDArray[Any]]]]
    selection: Selection
    above: str = ""
    below: str = ""
    groups: tuple[str, ...] = ()

    def cells(self) -> pl.LazyFrame:
        """suite, task_id, episode_index, replan, env_step, layer, block, denoise_step; norms of both sides,
        contribution_ratio (infinite or null where the denominator is 0), uniform_ratio and ratio_lift.
        """
        return frame_of_episodes(self.measured, self._cells)

    def norms(self) -> pl.LazyFrame:
        """The same names, group, norm; of every group that is made of whole segments in all episodes."""
        return frame_of_episodes(self.measured, self._norms)

    def ratios(self, sampling: Sampling) -> pl.DataFrame:
        """The ratio in every layer and over all of them, see `ratios_by_layer`."""
        then = partial(_means_of_episodes, above=self.above, below=self.below)
        return ratios_by_layer(frame_of_episodes(self.measured, self._cells, then).collect(), self.above, self.below,
                               sampling)  # fmt: skip

    def _cells(self, one: tuple[SelectedEpisode, Mapping[str, NDArray[Any]]]) -> pl.DataFrame:
        item, arrays = one
        values = {name: array for name, array in arrays.items() if name not in ("layer", "block", "norm", "env_step")}
        return long_table(item, self._axes(one), values)

    def _norms(self, one: tuple[SelectedEpisode, Mapping[str, NDArray[Any]]]) -> pl.DataFrame:
        return long_table(one[0], [*self._axes(one), {"group": list(self.groups)}], {"norm": one[1]["norm"]})

    def _axes(self, one: tuple[SelectedEpisode, Mapping[str, NDArray[Any]]]) -> list[Any]:
        _, arrays = one
        layer = {name: arrays[name] for name in ("layer", "block")}
        steps = arrays["env_step"]
        return [{"replan": range(len(steps)), "env_step": steps}, layer, denoise_axis(self.selection)]


def selected_gram(item: SelectedEpisode, site: str, selection: Selection) -> NDArray[np.float32]:
    """The Gram matrices (replan, layer, denoise, part, part) of the selected layers and denoise steps."""
    gram: NDArray[np.float32] = item.episode.read(f"{site}/contribution")
    return gram[:, list(selection.layers)][:, :, list(selection.denoise)]


def has_all_heads(root: RootAttributes, site: str) -> bool:
    """Whether all heads of a site were recorded."""
    return len(root.recording_of(site).heads) == (root.site(site).heads or root.policy.num_heads)


def joint_norm(gram: NDArray[np.floating], chosen: NDArray[np.bool_], weights: Array | None = None) -> Array:
    """Norm of the chosen parts' summed contribution (root mean square over the queries): sqrt(wᵀ G w).

    gram: (..., part, part); chosen: (part,) bool; weights: (..., part) of the parts, 1 without. Returns (...). Rounding
    may leave tiny negative squares: they are 0.
    """
    part = np.flatnonzero(chosen)
    inner = gram[..., part[:, None], part]
    if weights is not None:
        inner = inner * weights[..., part, None] * weights[..., None, part]
    norm: Array = np.sqrt(np.clip(inner.sum(axis=(-2, -1), dtype=np.float64), 0.0, None))
    return norm


def segment_masses(item: SelectedEpisode, site: str, selection: Selection) -> Array:
    """Masses (replan, layer, denoise, segment) of the selected layers and denoise steps, mean over all stored heads."""
    atoms = item.episode.read(f"{site}/atoms")[:, list(selection.layers)][:, :, list(selection.denoise)]
    return np.asarray(atoms.mean(axis=(3, 4), dtype=np.float64))


def uniform_weights(item: SelectedEpisode, site: str, selection: Selection) -> Array:
    """u_i of every part (replan, layer, denoise, part): its mass under uniform attention / its mass.

    0 for keys that are not valid, NaN for a valid part without mass, and NaN everywhere where not all heads were
    recorded, because contributions are of all heads. The block's whole update, the last part, is in no side: NaN.
    """
    root = item.store.attributes
    segments, tokens = item.episode.attributes.segments[site], item.episode.tokens(root, site)
    members = segment_members(tokens.layout, tokens.static_roles, segments) & tokens.valid[:, :, None]
    # All stored heads and all keys, also where some were taken out: contributions are of all.
    whole = replace(selection, heads=tuple(range(len(root.recording_of(site).heads))), per_head=False)
    here = replace(item, tokens=tokens, without=())
    uniform = uniform_masses(uniform_keys(here, whole), members.astype(np.float32))[:, :, :, 0]
    share = uniform / uniform.sum(axis=-1, keepdims=True)
    mass = segment_masses(item, site, selection)
    if not has_all_heads(root, site):
        mass = np.full_like(mass, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.where(share > 0, np.where(mass > 0, share / mass, np.nan), 0.0)
    return np.concatenate([weights, np.full((*weights.shape[:-1], 1), np.nan)], axis=-1)


def ratio_columns(above: tuple[Array, Array], below: tuple[Array, Array]) -> dict[str, Array]:
    """`contribution_ratio`, `uniform_ratio`, `ratio_lift`; each side is its norm and its norm of uniform attention."""
    value, uniform = ratio(above[0], below[0]), ratio(above[1], below[1])
    return {"contribution_ratio": value, "uniform_ratio": uniform, "ratio_lift": ratio(value, uniform)}


def side_norms(question: Question) -> Norms | None:
    """Norms of what all image keys and all text keys add; None without records, or in a run without such keys.

    A side is read at the site that has such keys: both at `joint` for pi, `self` and `cross` for Cosmos. Where the two
    sites are in different blocks, a ratio inside a block is undefined: the rows then are of the blocks of both, with
    the norm of the side that the block has, no ratio, and `visual_norm_of_uniform` and `linguistic_norm_of_uniform`.
    """
    selected, selection = question.selected, question.selection
    if not all(item.store.attributes.recording.contributions for item in selected):
        return None
    each = partial(_sides_of_episode, selection=selection, layers=question.settings.layers)
    norms = OnDisk(each_episode(each, selected))
    if not all(norms[i] for i in range(len(norms))):
        return None
    return Norms(_with_items(selected, norms), selection, "visual_norm", "linguistic_norm")


def group_norms(question: Question) -> Norms | None:
    """Norms of what the question's groups add; None without records or where every group cuts a segment."""
    selected, selection, grouping = question.selected, question.selection, question.grouping
    if not all(store.attributes.recording.contributions for store in question.stores):
        return None
    chosen = map_episodes(partial(_segments_of_groups, site=question.site, grouping=grouping), selected)
    # A group that cannot be measured in one episode would be a mean over the others only.
    names = tuple(name for name in grouping.names if all(name in parts for parts in chosen))
    if not names:
        return None
    each = partial(_groups_of_episode, selection=selection, site=question.site, grouping=grouping)
    measurable = [{name: parts[name] for name in names} for parts in chosen]
    norms = OnDisk(each_episode(each, zip(selected, measurable, strict=True)))
    sides = ("numerator_norm", "denominator_norm") if "numerator_norm" in norms[0] else ("", "")
    return Norms(_with_items(selected, norms), selection, *sides, groups=names)


def _with_items(selected: Sequence[SelectedEpisode], norms: OnDisk[Any]) -> Sequence[tuple[SelectedEpisode, Any]]:
    return MadeWhenAsked(lambda i: (selected[i], norms[i]), range(len(selected)))


def _sides_of_episode(
    item: SelectedEpisode, selection: Selection, layers: Sequence[int] | None
) -> dict[str, NDArray[Any]]:
    """The columns of one episode's norms (replan, layer, denoise), and the axes' labels; empty without a side."""
    root, episode = item.store.attributes, item.episode
    sides = [_parts_of_side(root, episode, roles) for roles in (VISUAL_ROLES, LINGUISTIC_ROLES)]
    if len({root.recording_of(side[0]).layers for side in sides if side}) > 1:
        return _of_different_blocks(item, selection, layers, [side for side in sides if side])
    sites = {side[0] for side in sides if side}
    grams = {site: selected_gram(item, site, selection) for site in sites}
    uniform = {site: uniform_weights(item, site, selection) for site in sites}
    norms = [
        (joint_norm(grams[side[0]], side[1]), joint_norm(grams[side[0]], side[1], uniform[side[0]]))
        for side in sides
        if side is not None
    ]
    if len(norms) < len(sides):
        return {}
    visual, linguistic = norms
    return {**_labels(item, selection), "visual_norm": visual[0], "linguistic_norm": linguistic[0],
            **ratio_columns(visual, linguistic)}  # fmt: skip


def _labels(item: SelectedEpisode, selection: Selection) -> dict[str, NDArray[Any]]:
    labels = {name: np.array(values) for name, values in layer_axis(selection).items()}
    return labels | {"env_step": np.asarray(replan_axis(item)["env_step"])}


def _of_different_blocks(
    item: SelectedEpisode,
    selection: Selection,
    layers: Sequence[int] | None,
    sides: Sequence[tuple[str, NDArray[np.bool_]]],
) -> dict[str, NDArray[Any]]:
    """The same where the sides are at sites in different blocks; empty where no chosen block has one of the sides."""
    root = item.store.attributes
    blocks_of = {
        site: tuple(b for b in root.recording_of(site).layers if layers is None or b in layers) for site, _ in sides
    }
    if len(sides) < 2 or not all(blocks_of.values()):
        return {}
    union = sorted({block for blocks in blocks_of.values() for block in blocks})
    shape = (item.tokens.num_replans, len(union), len(selection.denoise))
    values: dict[str, NDArray[Any]] = _labels(item, selection) | {"layer": np.array(union), "block": np.array(union)}
    for name, (site, parts) in zip(("visual_norm", "linguistic_norm"), sides, strict=True):
        recorded = root.recording_of(site).layers
        own = replace(selection, layers=tuple(recorded.index(block) for block in blocks_of[site]))
        gram, uniform = selected_gram(item, site, own), uniform_weights(item, site, own)
        at = [union.index(block) for block in blocks_of[site]]
        for column, norm in ((name, joint_norm(gram, parts)), (f"{name}_of_uniform", joint_norm(gram, parts, uniform))):
            values[column] = np.full(shape, np.nan)
            values[column][:, at] = norm
    return values | dict.fromkeys(("contribution_ratio", "uniform_ratio", "ratio_lift"), np.full(shape, np.nan))


def _parts_of_side(
    root: RootAttributes, episode: StoredEpisode, roles: Sequence[str]
) -> tuple[str, NDArray[np.bool_]] | None:
    """The first site that has segments with these roles, and which parts they are, (part,)."""
    for site in root.sites:
        segments: tuple[Segment, ...] = episode.attributes.segments[site.name]
        # The last part is the whole update of the block, and belongs to neither side.
        parts = np.array([*(segment.role in roles for segment in segments), False])
        if parts.any():
            return site.name, parts
    return None


def whole_segments(item: SelectedEpisode, resolved: ResolvedGrouping, site: str) -> dict[str, NDArray[np.bool_]]:
    """The parts of the Gram matrix that each group takes, (part,) bool; groups that cut a segment are left out.

    A group must take a segment whole or not at all, and the same ones at every replan that has the segment. The
    matrix's last part is the block's whole update, and belongs to no group.
    """
    tokens, segments = item.tokens, item.episode.attributes.segments[site]
    members = segment_members(tokens.layout, tokens.static_roles, segments)
    present = members.any(axis=1)
    parts = {}
    for i, name in enumerate(resolved.names):
        weights = weights_on_segments(resolved.weights[:, :, i : i + 1], members)
        if weights is None:
            continue
        taken = weights[:, :, 0].max(axis=0)
        if np.isin(taken, (0.0, 1.0)).all() and (~present | (weights[:, :, 0] == taken)).all():
            parts[name] = np.array([*(taken == 1.0), False])
    return parts


def _segments_of_groups(item: SelectedEpisode, site: str, grouping: Grouping) -> dict[str, NDArray[np.bool_]]:
    return whole_segments(item, resolve_episode(grouping, item), site)


def _groups_of_episode(
    pair: tuple[SelectedEpisode, Mapping[str, NDArray[np.bool_]]], selection: Selection, site: str, grouping: Grouping
) -> dict[str, NDArray[Any]]:
    """`norm` (replan, layer, denoise, group), the measures of both sides (replan, layer, denoise), the axes' labels."""
    item, parts = pair
    gram = selected_gram(item, site, selection)
    norm = np.stack([joint_norm(gram, taken) for taken in parts.values()], axis=-1)
    found = {**_labels(item, selection), "norm": norm}
    if grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= parts.keys():
        uniform = uniform_weights(item, site, selection)
        above, below = (
            (joint_norm(gram, taken), joint_norm(gram, taken, uniform))
            for side in (grouping.ratio.numerator, grouping.ratio.denominator)
            for taken in [np.any([parts[name] for name in side], axis=0)]
        )
        found |= {"numerator_norm": above[0], "denominator_norm": below[0], **ratio_columns(above, below)}
    return found


def _by_layer(rows: pl.DataFrame, measures: Sequence[pl.Expr], by: tuple[str, ...] = ()) -> pl.DataFrame:
    """Means over replans and denoise steps, one row per (episode, layer or "layers_avg", `by`); `layer` is a string.

    A block that was named by two layer numbers counts once in "layers_avg".
    """
    once = rows.select("layer", "block").unique(maintain_order=True).unique("block", keep="first")["layer"]
    layers = rows.group_by(*EPISODE_ID, "layer", *by, maintain_order=True).agg(*measures)
    average = rows.filter(pl.col("layer").is_in(once.implode())).group_by(*EPISODE_ID, *by, maintain_order=True)
    whole = average.agg(*measures).with_columns(pl.lit(LAYERS_AVG).alias("layer")).select(layers.columns)
    return pl.concat([layers.with_columns(pl.col("layer").cast(pl.String)), whole])


def _finite(name: str) -> pl.Expr:
    return pl.col(name).filter(pl.col(name).is_finite())


def _geometric_mean(name: str) -> pl.Expr:
    log = pl.col(name).log()
    return log.filter(log.is_finite()).mean().exp()


def _means_of_episodes(rows: pl.DataFrame, above: str, below: str) -> pl.DataFrame:
    """Per (episode, layer): mean norms, and the means of their ratio that `ratios_by_layer` lists."""
    ratios = [
        _finite("contribution_ratio").mean().alias("ratio_mean"),
        *(_geometric_mean(column).alias(name) for name, column in _GEOMETRIC.items()),
    ]
    found = _by_layer(rows, [pl.col(above, below).mean(), *ratios])
    if f"{above}_of_uniform" not in rows.columns:
        return found
    # The sides are in different blocks: the ratio over all of them is, at every replan and denoise step, of the means
    # of each side's norm over its blocks.
    cell = [*EPISODE_ID, "replan", "denoise_step"]
    once = rows.unique([*cell, "block"], keep="first", maintain_order=True)
    steps = once.group_by(cell, maintain_order=True).agg(
        pl.col(above, below, f"{above}_of_uniform", f"{below}_of_uniform").mean()
    )
    steps = steps.with_columns(
        (pl.col(above) / pl.col(below)).alias("contribution_ratio"),
        (pl.col(f"{above}_of_uniform") / pl.col(f"{below}_of_uniform")).alias("uniform_ratio"),
    ).with_columns((pl.col("contribution_ratio") / pl.col("uniform_ratio")).alias("ratio_lift"))
    over = steps.group_by(*EPISODE_ID, maintain_order=True).agg(*ratios)
    average = pl.col("layer") == LAYERS_AVG
    whole = found.filter(average).select(*EPISODE_ID, "layer", above, below)
    whole = whole.join(over, on=EPISODE_ID, how="left", maintain_order="left")
    return pl.concat([found.filter(~average), whole.select(found.columns)])


def ratios_by_layer(episodes: pl.DataFrame, above: str, below: str, sampling: Sampling) -> pl.DataFrame:
    """Norms and their ratio of every layer and over all of them ("layers_avg"), with intervals.

    Args:
        episodes: per (episode, layer) the means of `_means_of_episodes`.
        above, below: the columns of the norms.
        sampling: what the intervals are about, and which tasks are related.

    Returns:
        layer, layer_number (null for the average); means of `above` and `below`, geometric mean uniform_ratio; and with
        `_low` and `_high`
            geometric_mean    exp of the mean log ratio
            ratio_lift        geometric mean of ratio / uniform ratio
            ratio_mean        mean of the episodes' mean ratios of norms
            ratio_of_means    mean `above` / mean `below`
        Ratios that are infinite or undefined are in no mean but `ratio_of_means`.
    """
    values: dict[str, Scale] = dict.fromkeys((above, below, "ratio_mean"), "positive")
    values |= dict.fromkeys(_GEOMETRIC, "geometric")
    rows = estimate(episodes, ["layer"], values, sampling, quotients={"ratio_of_means": (above, below)})
    number = pl.col("layer").cast(pl.Int64, strict=False).alias("layer_number")
    bounded = ("ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift")
    ends = [f"{name}{end}" for name in bounded for end in ("", "_low", "_high")]
    return rows.select("layer", number, above, below, "uniform_ratio", *ends)
