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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.result import Column, Table
from vla_attention.analyze.measures.masses import finite_mean, ratio, uniform_keys, uniform_masses
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import OnDisk
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_episode
from vla_attention.analyze.measures.tables import LAYERS_AVG, Axis, frame_of_episodes, long_table
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import Segment, segment_members, weights_on_segments
from vla_attention.schemas.stores.store_format import RootAttributes

Array = NDArray[np.float64]
#: Roles of the keys on each side of the ratio: the images that the policy sees now, and the text.
VISUAL_ROLES = ("image",)
LINGUISTIC_ROLES = ("bos", "template", "instruction", "text")
_SIDES = ("visual_norm", "linguistic_norm")
_RATIOS = ("contribution_ratio", "uniform_ratio", "ratio_lift")
_COLUMNS = (
    Column("layer", "text"),
    Column("visual_norm", "number", "pictures", "length of the vector that the keys add to the residual stream"),
    Column("linguistic_norm", "number", "text"),
    Column("geometric_mean", "factor", "ratio"),
    Column("uniform_ratio", "number", "if even", "the ratio if attention were shared out evenly between the segments"),
    Column("ratio_lift", "factor", "over even", "ratio / ratio if even"),
)
#: An episode, and the arrays of its norms.
_Episode: TypeAlias = tuple[SelectedEpisode, Mapping[str, Any]]


@dataclass(frozen=True)
class Norms:
    """Norms of every episode, and the tables that are made of them.

    Attributes:
        measured: of each episode the columns of its cells (replan, layer, denoise), `norms` of groups by name, and
            labels of the axes: env_step, layer and block.
        selection: the denoise steps.
        above, below: the columns of the ratio's sides; empty without a ratio.
        groups: the groups whose norms there are.
    """

    measured: Sequence[_Episode]
    selection: Selection
    above: str = ""
    below: str = ""
    groups: tuple[str, ...] = ()

    def cells(self) -> pl.LazyFrame:
        """suite, task_id, episode_index, replan, env_step, layer, block, denoise_step; norms of both sides,
        contribution_ratio (infinite or null where the denominator is 0), uniform_ratio and ratio_lift.
        """
        labels = ("layer", "block", "norms", "env_step")

        def rows_of(one: _Episode) -> pl.DataFrame:
            values = {name: array for name, array in one[1].items() if name not in labels and self.above}
            return self._table(one, values)

        return frame_of_episodes(self.measured, rows_of)

    def norms(self) -> pl.LazyFrame:
        """The same names, group, norm; of every group that is made of whole segments in all episodes."""

        def rows_of(one: _Episode) -> pl.DataFrame:
            norm = np.stack([one[1]["norms"][name] for name in self.groups], axis=-1)
            return self._table(one, {"norm": norm}, {"group": self.groups})

        return frame_of_episodes(self.measured, rows_of)

    def _table(self, one: _Episode, values: Mapping[str, Array], *further: Axis) -> pl.DataFrame:
        item, arrays = one
        steps = arrays["env_step"]
        axes: list[Axis] = [
            {"replan": range(len(steps)), "env_step": steps},
            {name: arrays[name] for name in ("layer", "block")},
            {"denoise_step": self.selection.denoise_steps},
        ]
        return long_table(item, [*axes, *further], values)

    def ratios(self, sampling: Sampling) -> pl.DataFrame:
        """Norms and their ratio of every layer and over all of them ("layers_avg"), with intervals.

        Returns:
            layer, layer_number (null for the average); means of `above` and `below`, geometric mean uniform_ratio; and
            with `_low` and `_high`
                geometric_mean    exp of the mean log ratio
                ratio_lift        geometric mean of ratio / uniform ratio
                ratio_mean        mean of the episodes' mean ratios of norms
                ratio_of_means    mean `above` / mean `below`
            Ratios that are infinite or undefined are in no mean but `ratio_of_means`.
        """
        episodes = frame_of_episodes(self.measured, self._means).collect()
        values: dict[str, Scale] = dict.fromkeys((self.above, self.below, "ratio_mean"), "positive")
        values |= dict.fromkeys(("geometric_mean", "uniform_ratio", "ratio_lift"), "geometric")
        rows = estimate(episodes, ["layer"], values, sampling, quotients={"ratio_of_means": (self.above, self.below)})
        bounded = ("ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift")
        ends = [f"{name}{end}" for name in bounded for end in ("", "_low", "_high")]
        number = pl.col("layer").cast(pl.Int64, strict=False).alias("layer_number")
        return rows.select("layer", number, self.above, self.below, "uniform_ratio", *ends)

    def _means(self, one: _Episode) -> pl.DataFrame:
        """Means over replans and denoise steps, a row for each layer and "layers_avg"; a block counts once there."""
        item, arrays = one
        sides = (self.above, self.below)
        layers = {name: arrays[name] for name in (*sides, *_RATIOS)}
        once = np.sort(np.unique(arrays["block"], return_index=True)[1])
        whole = {name: array[:, once] for name, array in layers.items()}
        if f"{self.above}_of_uniform" in arrays:
            # The sides are in different blocks: the ratio over all of them is, at every replan and denoise step, of the
            # means of each side's norm over its blocks.
            norms = [[finite_mean(arrays[f"{side}{end}"][:, once], 1)[:, None] for end in ("", "_of_uniform")]
                     for side in sides]  # fmt: skip
            whole |= ratio_columns(*norms)

        def over(name: str, log: bool = False) -> Array:
            with np.errstate(divide="ignore"):
                of_layers, of_all = (np.log(part[name]) if log else part[name] for part in (layers, whole))
            means = np.append(finite_mean(of_layers, (0, 2)), finite_mean(of_all, (0, 1, 2)))
            return np.exp(means) if log else means

        values = {name: over(name) for name in sides} | {"ratio_mean": over("contribution_ratio")}
        logs = zip(("geometric_mean", "uniform_ratio", "ratio_lift"), _RATIOS, strict=True)
        values |= {name: over(column, log=True) for name, column in logs}
        return long_table(item, [{"layer": [*map(str, arrays["layer"]), LAYERS_AVG]}], values)


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
    return np.asarray(atoms[..., :-1].mean(axis=(3, 4), dtype=np.float64))


def uniform_weights(item: SelectedEpisode, site: str, selection: Selection) -> Array:
    """u_i of every part (replan, layer, denoise, part): its mass under uniform attention / its mass.

    0 for keys that are not valid, NaN for a valid part without mass, and NaN everywhere where not all heads were
    recorded, because contributions are of all heads. The block's whole update, the last part, is in no side: NaN.
    """
    root = item.store.attributes
    tokens = item.tokens if item.tokens.layout.name == site else item.episode.tokens(root, site)
    segments = item.episode.attributes.segments[site]
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


def ratio_columns(above: Sequence[Array], below: Sequence[Array]) -> dict[str, Array]:
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
    norms: OnDisk[_Episode] = OnDisk(
        lambda i, arrays: (selected[i], arrays), contents=each_episode(each, _fresh(selected))
    )
    if not all(arrays for _, arrays in norms):
        return None
    return Norms(norms, selection, *_SIDES)


def group_norms(question: Question) -> Norms | None:
    """Norms of what the question's groups add; None without records or where every group cuts a segment."""
    selected, selection, grouping = question.selected, question.selection, question.grouping
    if not all(store.attributes.recording.contributions for store in question.stores):
        return None
    each = partial(_groups_of_episode, selection=selection, site=question.site, grouping=grouping)
    norms: OnDisk[_Episode] = OnDisk(
        lambda i, arrays: (selected[i], arrays), contents=each_episode(each, _fresh(selected))
    )
    # A group that cannot be measured in one episode would be a mean over the others only.
    names = set.intersection(*(set(arrays["norms"]) for _, arrays in norms))
    if not names:
        return None
    has_sides = grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= names
    sides = ("numerator_norm", "denominator_norm") if has_sides else ("", "")
    return Norms(norms, selection, *sides, groups=tuple(name for name in grouping.names if name in names))


def _fresh(selected: Sequence[SelectedEpisode]) -> Iterator[SelectedEpisode]:
    return (item.fresh() for item in selected)


def _sides_of_episode(item: SelectedEpisode, selection: Selection, layers: Sequence[int] | None) -> dict[str, Any]:
    """The columns of one episode's norms (replan, layer, denoise), and the axes' labels; empty without a side."""
    root = item.store.attributes
    sides = [side for roles in (VISUAL_ROLES, LINGUISTIC_ROLES) if (side := _parts_of_side(item, roles)) is not None]
    if len(sides) < 2:
        return {}
    labels = {"layer": selection.layer_labels, "block": selection.blocks}
    chosen, places = [selection] * 2, [list(range(len(selection.layers)))] * 2
    recorded = [root.recording_of(site).layers for site, _ in sides]
    if recorded[0] != recorded[1]:
        blocks = [[block for block in one if layers is None or block in layers] for one in recorded]
        union = tuple(sorted({*blocks[0], *blocks[1]}))
        labels, places = {"layer": union, "block": union}, [[union.index(block) for block in own] for own in blocks]
        chosen = [
            replace(selection, layers=tuple(one.index(block) for block in own))
            for one, own in zip(recorded, blocks, strict=True)
        ]
        if not all(blocks):
            return {}
    sites = {site: own for (site, _), own in zip(sides, chosen, strict=True)}
    read = {site: (selected_gram(item, site, own), uniform_weights(item, site, own)) for site, own in sites.items()}
    values: dict[str, Any] = {}
    for name, (site, parts), at in zip(_SIDES, sides, places, strict=True):
        gram, uniform = read[site]
        for end, weights in (("", None), ("_of_uniform", uniform)):
            norm = joint_norm(gram, parts, weights)
            values[name + end] = np.full((len(norm), len(labels["block"]), norm.shape[2]), np.nan)
            values[name + end][:, at] = norm
    ratios = ratio_columns(*([values[name], values[f"{name}_of_uniform"]] for name in _SIDES))
    if recorded[0] != recorded[1]:
        values |= {name: np.full_like(array, np.nan) for name, array in ratios.items()}
    else:
        values = {name: values[name] for name in _SIDES} | ratios
    return _labels(item, labels) | values


def _labels(item: SelectedEpisode, layers: Mapping[str, Sequence[int]]) -> dict[str, NDArray[Any]]:
    labels = {name: np.array(values) for name, values in layers.items()}
    return labels | {"env_step": item.episode.read("env_step").astype(np.int64)}


def _parts_of_side(item: SelectedEpisode, roles: Sequence[str]) -> tuple[str, NDArray[np.bool_]] | None:
    """The first site that has segments with these roles, and which parts they are, (part,)."""
    for site in item.store.attributes.sites:
        segments: tuple[Segment, ...] = item.episode.attributes.segments[site.name]
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
        weights, cut = weights_on_segments(resolved.weights[:, :, i : i + 1], members)
        if cut.any():
            continue
        taken = weights[:, :, 0].max(axis=0)
        if np.isin(taken, (0.0, 1.0)).all() and (~present | (weights[:, :, 0] == taken)).all():
            parts[name] = np.array([*(taken == 1.0), False])
    return parts


def _groups_of_episode(item: SelectedEpisode, selection: Selection, site: str, grouping: Grouping) -> dict[str, Any]:
    """`norms` by group, the measures of both sides if it has them, (replan, layer, denoise) each; the axes' labels."""
    parts, gram = whole_segments(item, resolve_episode(grouping, item), site), selected_gram(item, site, selection)
    norms = {name: joint_norm(gram, part) for name, part in parts.items()}
    found = _labels(item, {"layer": selection.layer_labels, "block": selection.blocks}) | {"norms": norms}
    if grouping.ratio is not None and {*grouping.ratio.numerator, *grouping.ratio.denominator} <= parts.keys():
        uniform = uniform_weights(item, site, selection)
        above, below = (
            [joint_norm(gram, taken), joint_norm(gram, taken, uniform)]
            for side in (grouping.ratio.numerator, grouping.ratio.denominator)
            for taken in [np.any([parts[name] for name in side], axis=0)]
        )
        found |= {"numerator_norm": above[0], "denominator_norm": below[0], **ratio_columns(above, below)}
    return found


def tables_of_norms(question: Question) -> list[Table]:
    """What pictures, text and groups add to the residual stream, where it was recorded."""
    tables = []
    if (norms := side_norms(question)) is not None:
        ratios, average = norms.ratios(question.sampling), pl.col("layer") == LAYERS_AVG
        tables = [Table("contributions", ratios, _COLUMNS, "What the tokens add", average)]
        tables.append(Table("contributions_steps", norms.cells()))
    if (of_groups := group_norms(question)) is not None:
        tables.append(Table("group_contributions", of_groups.norms()))
        if of_groups.above:
            tables.append(Table("group_contribution_ratios", of_groups.cells()))
    return tables
