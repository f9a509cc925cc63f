"""Effects that runs recorded beside their calls (`schemas.effects`): how the action changes without an item.

An item is what was taken away or exchanged: a word, a picture, an object, a part of the prompt. A reader is who no
longer reads it: nobody reads it (`total`), the action queries do not (`direct`), or the tokens of the pictures, or of
the text, do not.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.action_changes import (
    EFFECT,
    ROUNDING,
    ActionUnits,
    BaseEpisode,
    first_angle,
    units_of,
)
from vla_attention.analyze.core.axes import weighted, with_families
from vla_attention.analyze.core.contributions import joint_norm, selected_gram, whole_segments
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.measure import Items, Measured, means, measure
from vla_attention.analyze.measures.question import Question, select_again
from vla_attention.analyze.measures.scan import OnDisk
from vla_attention.analyze.measures.selected import SelectedEpisode, load_tokens, resolve_episode, vocabulary_of
from vla_attention.analyze.measures.tables import EPISODE_ID, episode_columns, frame_of_episodes
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.effects import CHANGE, EffectItem
from vla_attention.schemas.errors import BadArgument, UnknownName, listing, plural
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import check_names
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.safe_text import visible

#: Parts of an episode's time.
TIME_PARTS = 10
#: The part of the gripper.
GRIPPER = "gripper"
#: Parts of the prompt, other sentences and pictures -> what they are called.
_PARTS = {"bos": "first token", "template": "fixed words of the prompt", "instruction": "whole instruction",
          "state": "state digits"}  # fmt: skip
_SENTENCES = {"empty": "the instruction empty", "shuffled": "the instruction's words shuffled"}
_PICTURES = {"blank": "grey", "mean": "as the task's mean"}
#: Whose attention is cut -> how an effect without it is called.
_READERS = {"all": "total", "action": "direct"}
_EPISODE = (*EPISODE_ID[:2], "instruction", EPISODE_ID[2])
#: What names a row: the condition as it was recorded, what it changed (`schemas.effects.EffectItem`), and how sentences
#: call that.
NAMES = ("condition", "kind", "item", "item_kind", "instead", "label", "selector", "reader")
#: Of these, what tells items apart, whoever does not read them.
ITEM = ("kind", "item_kind", "item", "instead", "label")
_ATTENTION = ("keys", "mass", "lift", "norm")
#: Beside the parts: of the first one over whole chunks, and the angle between the first actions' translations.
_CHUNK, _ANGLE = "effect_chunk", "angle"
_VALUES: dict[str, Scale] = {
    **dict.fromkeys((_CHUNK, _ANGLE, *_ATTENTION, "noise"), "positive"),
    **dict.fromkeys(("minus_noise", "times_noise", "gripper_minus_noise"), "plain"),
}


_Episode: TypeAlias = tuple[SelectedEpisode, Mapping[str, Any], Sequence[Measured]]


@dataclass(frozen=True)
class RecordedEffects:
    """The recorded effects of the selected episodes; frames are made of them when they are asked for.

    Attributes:
        question: stores and selection.
        units: what changes are measured by.
        measured: of each episode itself, its arrays by entry, and its attention to the items, site by site.
        notes: how far unchanged calls are from those that the robot executed; items that are read at another site.
    """

    question: Question
    units: ActionUnits
    measured: Sequence[_Episode]
    notes: tuple[str, ...]

    def rows(self) -> pl.LazyFrame:
        """One row per recorded replan and condition.

        Returns:
            suite, task_id, instruction, episode_index, replan, env_step; begin, end (the part of the episode's time in
            which the call's actions were executed, 0 to 1); `NAMES`; the parts of `units`, the first as `effect`;
            effect_chunk, that over the whole chunk; angle in degrees between the first actions' translations; and
            keys, mass, lift and norm of the item in the same replan (norm: of its contribution to the residual stream).
        """
        return frame_of_episodes(self.measured, partial(_rows, parts=self.units.names))

    def episodes(self, by: Collection[str] = ()) -> pl.DataFrame:
        """Means over the replans of every episode, condition and cell of the axes `by` (replan, time, ...).

        Returns:
            suite, task_id, instruction, episode_index, family, the axes' columns, `NAMES`, num_replans; the values of
            `rows`; noise: the effect of another noise seed there, minus_noise: the effect minus it, times_noise: the
            logarithm of their quotient; gripper_minus_noise, where the gripper is known.
        """
        cells = [name for axis, name in (("replan", "replan"), ("replan", "env_step"), ("time", "phase")) if axis in by]
        then = partial(_means, cells=cells, values=(*self.units.names, _CHUNK, _ANGLE, *_ATTENTION))
        rows = frame_of_episodes(self.measured, partial(_rows, parts=self.units.names), then).collect()
        place = [*EPISODE_ID, *cells]
        known = [name for name in (EFFECT, GRIPPER) if name in rows.columns]
        noise = rows.filter(kind="noise").group_by(place).agg(pl.col(name).mean().alias(f"_{name}") for name in known)
        rows = rows.join(noise, on=place, how="left", maintain_order="left")
        apart, quotient = pl.col("kind") != "noise", times(EFFECT, f"_{EFFECT}")
        minus = {"minus_noise": EFFECT} | ({"gripper_minus_noise": GRIPPER} if GRIPPER in known else {})
        rows = rows.with_columns(
            pl.when(apart).then(f"_{EFFECT}").alias("noise"),
            pl.when(apart).then(quotient).alias("times_noise"),
            *(pl.when(apart).then(pl.col(of) - pl.col(f"_{of}")).alias(name) for name, of in minus.items()),
        )
        return with_families(rows.drop(f"_{name}" for name in known), self.question.sampling)


def times(effect: str, noise: str) -> pl.Expr:
    """The logarithm of an effect over another one; what is below rounding counts as rounding, so that it is finite."""
    above, below = (pl.col(name).clip(lower_bound=ROUNDING) for name in (effect, noise))
    return (above / below).log()


def summary_of(
    episodes: pl.DataFrame, units: ActionUnits, sampling: Sampling, looks: Sequence[str] = ()
) -> pl.DataFrame:
    """Means over episodes with intervals, see `estimate`: the largest effects first.

    Args:
        episodes: as `RecordedEffects.episodes` gives them.
        units: of the effects.
        sampling: what intervals are about.
        looks: columns that tell cells apart.

    Returns:
        looks, `NAMES`, num_episodes, num_tasks; the values of `episodes`; over_noise, the mean effect / that of another
        noise seed. times_noise_q (of no difference from another noise seed), gripper_minus_noise_q and lift_q are
        adjusted for the conditions of a cell with the same reader, without those of random keys; times_noise_detectable
        is what would have been shown in 80 % of runs of this size, if it were the only one.
    """
    # What is named is one row an item: of its total effect, or where that was not tried of the direct one.
    reader = pl.col("reader").fill_null("total")
    look = pl.when(pl.col("kind") == "random").then(pl.lit("random")).otherwise(reader)
    values = {name: scale for name, scale in (units.scales | _VALUES).items() if name in episodes.columns}
    # By the effect or by the gripper an item is named.
    nulls = {"lift": 1.0} | {name: 0.0 for name in ("times_noise", "gripper_minus_noise") if name in values}
    rows = episodes.with_columns(_look=look)
    num_looks = max(rows.group_by("_look").agg(pl.n_unique("condition"))["condition"].to_list(), default=1)
    found = estimate(
        rows, [*looks, *NAMES, "_look"], values, sampling, nulls, [*looks, "_look"], {"over_noise": (EFFECT, "noise")},
        [name for name in nulls if name != "lift"],
        {"times_noise": NAMED_AT / num_looks} if "times_noise" in nulls else None,
    )  # fmt: skip
    known = pl.col("_look") != "random"
    found = found.with_columns(pl.when(known).then(f"{name}_q").alias(f"{name}_q") for name in nulls).drop("_look")
    order = [*looks, "effect", "condition"]
    return found.sort(order, descending=[name == "effect" for name in order], nulls_last=True)


def recorded_effects(
    question: Question, attention: bool = True, units: ActionUnits | None = None
) -> RecordedEffects | None:
    """The effects that a question's stores recorded; None where they recorded none.

    attention: whether the items' attention is measured too. units: others than the stores' own.

    Raises:
        BadArgument: none that they recorded can be shown; see `units_of`.
    """
    having = [item for item in question.selected if item.episode.attributes.effects is not None]
    if not having:
        if all(store.attributes.recording.effects is None for store in question.stores):
            return None
        raise BadArgument(_NOT_SHOWN.format(question.stores[0].path, "None was measured in a selected episode."))
    if units is None:
        units = units_of(question.stores, question.settings.units, question.settings.skip_corrupt)
    places = _places(replace(question, selected=tuple(having))) if attention else []
    measured = [measure(at, partial(selected_items, selectors=selectors), "effects") for at, selectors in places]
    each = partial(_arrays, units=units, places=[(at.site, at.selection, selectors) for at, selectors in places])

    def made(i: int, arrays: Mapping[str, Any]) -> _Episode:
        return having[i], arrays, [at_site[i] for at_site in measured]

    together = (
        [item.fresh() for item in items] for items in zip(having, *(at.selected for at, _ in places), strict=True)
    )
    episodes = OnDisk(made, contents=each_episode(each, together))
    drift = _drift(episodes, units)
    elsewhere = [
        f"Attention to {plural(len(selectors), 'item')} is of site '{at.site}', where the keys are."
        for at, selectors in places
        if at.site != question.site
    ]
    effects = (item.episode.attributes.effects for item in having)
    silent = {block for one in effects if one is not None for block in one.silent_blocks}
    hybrid = (
        f"Through softmax only, also where nobody reads it: tokens are not cut off in {plural(len(silent), 'block')} "
        f"without softmax attention ({listing(sorted(silent), 3)}). Exchanges of words and pictures are whole."
    )
    notes = (*units.notes, *[hybrid] * bool(silent), *drift, *elsewhere)
    found = RecordedEffects(question, units, episodes, notes)
    if found.rows().head(1).collect().is_empty():
        said = drift or ("None was measured in a selected replan.",)
        raise BadArgument(_NOT_SHOWN.format(question.stores[0].path, " ".join(said)))
    return found


_NOT_SHOWN = "No effect that {} holds can be shown. {}"


def named(item: EffectItem, given: Interventions) -> dict[str, str | None]:
    """`NAMES` of a condition."""
    name, instead = visible(item.name), visible(item.instead)
    return {
        "condition": visible(given.name),
        "kind": item.change,
        "item": name,
        "item_kind": item.kind,
        "instead": instead,
        "label": _label(item.change, item.kind, name, instead),
        "selector": visible(given.keys[0].selector) if given.keys else None,
        "reader": _READERS.get(item.reader, item.reader or None),
    }


def _label(change: str, kind: str, name: str, instead: str) -> str:
    """What a condition changed, as a sentence names it."""
    if change == "noise":
        return "another noise seed"
    if change == "prompt":
        said = f"'{instead}'" if instead else _SENTENCES.get(kind, kind)
        return f"'{name}' as {said}" if kind == "exchange" else said
    if change == "image":
        return f"{name} {_PICTURES.get(instead, instead)}"
    of_kind = {"pictures": "all pictures", "text": "all text", "word": f"'{name}'", "token": f"token {name}",
               "object": name.replace("_", " ")}  # fmt: skip
    said = _PARTS.get(name, name) if kind == "part" else of_kind.get(kind, name)
    if change == "only":
        return f"only the {kind if kind in ('pictures', 'text') else said}"
    return f"random tokens, as many as {said}" if change == "random" else said


def _places(question: Question) -> list[tuple[Question, tuple[str, ...]]]:
    """The selectors of all items, each where it names keys: at the question's site, else at the next one that has them.

    No other site is looked at where the user chose one.
    """
    texts = dict.fromkeys(
        knockout.selector
        for item in question.selected
        if (effects := item.episode.attributes.effects) is not None
        for condition in effects.conditions
        for knockout in condition.keys
    )
    sites = [site.name for site in question.stores[0].attributes.sites if site.name != question.site]
    found, left = [], list(texts)
    for site in [question.site, *(sites if question.settings.site is None else [])]:
        try:
            at = question if site == question.site else _at_site(question, site)
        except BadArgument:  # the chosen layers are none of that site's
            continue
        here = tuple(text for text in left if _has_name(at, text))
        if here and sites:
            keys = [resolve_episode(_grouping(here), item).num_keys for item in at.selected]
            having = np.any([of_episode.any(axis=0) for of_episode in keys], axis=0)
            here = tuple(text for text, has in zip(here, having, strict=True) if has)
        if here:
            found.append((at, here))
            left = [text for text in left if text not in here]
    return found


def _at_site(question: Question, site: str) -> Question:
    selected, selection = tuple(load_tokens(question.episodes, site)), select_again(question, site)
    return replace(question, site=site, selected=selected, vocabulary=vocabulary_of(selected), selection=selection)


def _has_name(question: Question, selector: str) -> bool:
    try:
        check_names(_grouping((selector,)), question.vocabulary)
    except (SelectorError, UnknownName):  # a site of pictures has no words
        return False
    return True


def _grouping(selectors: Sequence[str]) -> Grouping:
    """Each selector as a group of its own; in brackets, since '*' alone in a group means the rest."""
    members = {f"item{i}": (f"({text})",) for i, text in enumerate(selectors)}
    return Grouping("effects", members, overlap=True, allow_empty=tuple(members))


def selected_items(
    item: SelectedEpisode, selectors: Sequence[str], absent: Literal["left out", "zero"] = "left out"
) -> Items:
    """What each selector takes as an item."""
    weights = resolve_episode(_grouping(selectors), item).weights
    names = pl.Series([visible(text) for text in selectors], dtype=pl.String)
    return Items({"selector": names}, weights, absent=absent)


def _arrays(
    items: Sequence[SelectedEpisode], units: ActionUnits, places: Sequence[tuple[str, Selection, Sequence[str]]]
) -> dict[str, Any]:
    """By entry replan, condition, begin, end, changes (entry, part), chunk, angle; norms (replan, selector) by place.

    items: the episode, then with the tokens of each place's site.
    """
    item, *at_places = items
    effects, base = item.episode.attributes.effects, BaseEpisode.of(item)
    assert effects is not None
    replan = np.array(effects.replan, np.int64)
    at, change = base.at(replan), np.zeros((0, *base.actions.shape[1:]))
    if item.episode.has(CHANGE):
        change = item.episode.read(CHANGE).astype(np.float64) * np.array(effects.units)
    # Which numbers move the hand is known of our suites only.
    known = not item.store.attributes.protocol.of_other_loop
    edges = np.append(base.starts, base.num_steps) / base.num_steps
    return {
        "replan": replan,
        "condition": np.array(effects.condition, np.int64),
        "env_step": base.env_step[replan],
        "begin": edges[:-1][replan],
        "end": edges[1:][replan],
        "changes": units.changes(at, at.actions + change),
        "chunk": units.chunk_change(at, at.actions + change),
        "angle": first_angle(at.actions, at.actions + change) if known else np.full(len(replan), np.nan),
        "norms": [_norms(one, *place) for one, place in zip(at_places, places, strict=True)],
    }


def _norms(item: SelectedEpisode, site: str, selection: Selection, selectors: Sequence[str]) -> NDArray[np.float64]:
    """Norms of the items' contributions, (replan, selector), means over layers and denoise steps; NaN where none is."""
    norm = np.full((item.episode.attributes.num_replans, len(selectors)), np.nan)
    if item.store.attributes.recording.contributions:
        gram = selected_gram(item, site, selection)[:, list(selection.once)]
        parts = whole_segments(item, resolve_episode(_grouping(selectors), item), site)
        for i in range(len(selectors)):
            if f"item{i}" in parts:
                norm[:, i] = joint_norm(gram, parts[f"item{i}"]).mean(axis=(1, 2))
    return norm


def _rows(one: _Episode, parts: Sequence[str]) -> pl.DataFrame:
    """`RecordedEffects.rows` of one episode."""
    item, arrays, measured = one
    effects = item.episode.attributes.effects
    assert effects is not None
    names = [named(of, given) for of, given in zip(effects.items, effects.conditions, strict=True)]
    conditions = pl.DataFrame(names, schema=dict.fromkeys(NAMES, pl.String))[arrays["condition"]]
    keys = episode_columns(item, _EPISODE, len(conditions))
    place = {name: arrays[name] for name in ("replan", "env_step", "begin", "end")}
    values = {name: arrays["changes"][:, i] for i, name in enumerate(parts)}
    values |= {_CHUNK: arrays["chunk"], _ANGLE: arrays["angle"]}
    rows = pl.DataFrame({**keys, **place, **conditions.to_dict(), **values}).filter(pl.col("kind") != "nothing")
    found = [
        means(at_site, ("replan",)).with_columns(norm=norm.ravel()).select("replan", "selector", *_ATTENTION)
        for at_site, norm in zip(measured, arrays["norms"], strict=True)
    ]
    schema = {"replan": pl.Int64, "selector": pl.String, **dict.fromkeys(_ATTENTION, pl.Float64)}
    attention = pl.concat([pl.DataFrame(schema=schema), *found])
    joined = rows.join(attention, on=["replan", "selector"], how="left", maintain_order="left")
    return joined.with_columns(pl.col(*values, *_ATTENTION).fill_nan(None))


def _means(rows: pl.DataFrame, cells: Sequence[str], values: Sequence[str]) -> pl.DataFrame:
    """Means over the replans of each episode, condition and cell; of parts of the time by how long a replan lasts."""
    weight = pl.lit(1.0)
    if "phase" in cells:
        edges = np.linspace(0.0, 1.0, TIME_PARTS + 1)
        parts = pl.DataFrame({"_low": edges[:-1], "_high": edges[1:]}).with_columns(
            phase=((pl.col("_low") + pl.col("_high")) / 2).round(6)
        )
        lasts = pl.min_horizontal("_high", "end") - pl.max_horizontal("_low", "begin")
        # Rounding can make neighbours overlap by a tiny amount.
        rows = rows.join(parts, how="cross").with_columns(_weight=lasts).filter(pl.col("_weight") > 1e-12)
        weight = pl.col("_weight")
    names = [*_EPISODE, *cells, *NAMES]
    return rows.group_by(names, maintain_order=True).agg(
        pl.len().cast(pl.Int64).alias("num_replans"),
        *(weighted(pl.col(name), weight).alias(name) for name in values),
    )


def _drift(episodes: Sequence[_Episode], units: ActionUnits) -> tuple[str, ...]:
    """How far calls without a change are from those that the robot executed, if rounding does not explain it."""
    most, where = 0.0, ""
    for item, arrays, _ in episodes:
        effects = item.episode.attributes.effects
        assert effects is not None
        nothing = [i for i, of in enumerate(effects.items) if of.change == "nothing"]
        sizes = np.where(np.isin(arrays["condition"], nothing), arrays["chunk"], 0)
        if sizes.size and sizes.max() > most:
            most = float(sizes.max())
            where = f"policy call {int(arrays['replan'][sizes.argmax()])} of {item.episode.name}"
    if most <= ROUNDING:
        return ()
    return (
        f"Calls that were made again without any change differ from the executed ones: "
        f"{units.said(f'up to {most:.2g}')} ({where}). Effects that are not far above that are none.",
    )
