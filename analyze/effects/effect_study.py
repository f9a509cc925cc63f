"""How much actions change in every condition, beside attention, noise and random keys: the tables of the command.

The episode is the unit. Effects of an episode are means over its replans; each is compared, in the same episode, with
that of another noise seed and with that of equally many random keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.same_calls import held_by_one
from vla_attention.analyze.effects.action_changes import (
    ActionSpread,
    action_spread,
    noise_of,
    with_noise,
)
from vla_attention.analyze.effects.base_attention import Analysis
from vla_attention.analyze.effects.conditions import Condition, Kind
from vla_attention.analyze.effects.floors import NAMES, summary_of, with_floors
from vla_attention.analyze.effects.group_attention import MEASURES, GroupAttention, group_attention
from vla_attention.analyze.effects.paired_replans import (
    ALL,
    CHANGES,
    BaseEpisode,
    Pairing,
    actions_of,
    changes_of,
    changes_recorded,
    mean_over_phases,
    pair_episodes,
    stores_executed,
)
from vla_attention.analyze.effects.reruns import BaseAndReruns, open_reruns, recorded_conditions
from vla_attention.analyze.effects.rollouts import ROLLOUT_COLUMNS, rollout_pairs, rollout_summary
from vla_attention.analyze.effects.sums import sums_of_groups
from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import SelectedEpisode, load_tokens
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.stores.parallel import map_episodes
from vla_attention.analyze.stores.run_notes import run_notes
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.schemas.stores.store_url import StorePlace

#: Change of an unchanged call among those made together that float32 explains, in spreads; bfloat16 leaves .02 to .05.
_MOST_ROUNDING = 1e-3
_Row = dict[str, object]
_ID: dict[str, Any] = {"suite": pl.String, "task_id": pl.Int64, "instruction": pl.String, "episode_index": pl.Int64}
_EPISODE_SCHEMA: dict[str, Any] = {
    **_ID,
    **dict.fromkeys(NAMES, pl.String),
    "phase": pl.String,
    "num_replans": pl.Int64,
    **dict.fromkeys((*CHANGES, *MEASURES), pl.Float64),
}


@dataclass(frozen=True)
class EffectStudy:
    """Everything that `effects` computes.

    Attributes:
        analysis: the base by itself, with the ratio and its lift.
        given: the stores.
        spread: the units of changes.
        attention: the base's attention to the groups of the conditions.
        episodes: one row per (condition, episode, phase): suite, task_id, instruction, episode_index, condition, kind,
            group, selector, phase ("all" or a third of the episode), num_replans; `CHANGES`; the base's mass, lift,
            norm and keys of the group in the same replans; noise (the effect of another noise seed in this episode and
            phase) and random (of random keys, as many), with minus_noise and minus_random, the effect minus each. Null
            where there is no such rerun. Replans in which the group has no keys in the base, such as a word that is in
            other instructions, are left out, and episodes of which nothing is left.
        rollout_episodes: one row per (condition, pair of rollouts), see `rollouts.rollout_pairs`.
        notes: what was left out, and what is not there.
        sums: of recorded effects, for groups that were not measured together; see `sums.sums_of_groups`.
    """

    analysis: Analysis
    given: BaseAndReruns
    spread: ActionSpread
    attention: dict[Any, GroupAttention]
    episodes: pl.DataFrame
    rollout_episodes: pl.DataFrame
    notes: tuple[str, ...]
    sums: pl.DataFrame = field(default_factory=pl.DataFrame)

    @property
    def question(self) -> Question:
        """The question about the base."""
        return self.analysis.question

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The reruns, in the order of their files."""
        return self.given.reruns

    @cached_property
    def summary(self) -> pl.DataFrame:
        """Means over episodes with intervals, see `summary_of`."""
        return summary_of(self.episodes, self.question.sampling)

    @cached_property
    def rollouts(self) -> pl.DataFrame:
        """Success and length of paired rollouts, see `rollouts.rollout_summary`."""
        return rollout_summary(self.rollout_episodes, self.question.sampling)

    @property
    def is_recorded(self) -> bool:
        """Whether the effects are those that the base measured beside its calls."""
        return any(condition.recorded for condition in self.conditions)

    @property
    def measured(self) -> tuple[int, int]:
        """The numbers of episodes and tasks in which any effect was measured: a rerun may have a part of the base's."""
        whole = self.episodes.select("suite", "task_id", "episode_index").unique()
        return len(whole), len(whole.select("suite", "task_id").unique())

    def of(self, condition: Condition) -> dict[str, Any]:
        """The row of `summary` over all tasks and replans."""
        return self._over_all[condition.name]

    @cached_property
    def _over_all(self) -> dict[str, dict[str, Any]]:
        """The rows of `summary` over all tasks and replans, by condition."""
        rows = self.summary.filter(scope="all", phase=ALL).iter_rows(named=True)
        return {row["condition"]: row for row in rows}

    def of_kind(self, *kinds: Kind) -> list[Condition]:
        """The conditions of some kinds."""
        return [condition for condition in self.conditions if condition.kind in kinds]


def study_effects(
    base: StorePlace, given: Sequence[StorePlace], settings: AnalysisSettings, dimensions: Sequence[int] | None = None
) -> EffectStudy:
    """Open a base and its reruns (`reruns.open_reruns`) and measure every pair of replans.

    `dimensions`: the dimensions of the action that are compared; all that have spread unless given.

    Raises:
        UserError: see `open_reruns`, `question.ask` and `paired_replans.pair_episodes`.
    """
    opened = open_reruns(open_store(base), given)
    return study_of(Analysis(ask([opened.base], settings)), opened, dimensions)


def recorded_study(stores: Sequence[Store], settings: AnalysisSettings) -> EffectStudy | None:
    """The effects that a store measured beside its calls; None without any, and for several stores.

    Raises:
        BadArgument: none that it measured can be shown.
    """
    if len(stores) != 1 or not recorded_conditions(stores[0]):
        return None
    return study_effects(stores[0].path, [], settings)


def study_of(analysis: Analysis, opened: BaseAndReruns, dimensions: Sequence[int] | None = None) -> EffectStudy:
    """As `study_effects`, of a base that was analysed already."""
    question = analysis.question
    everything = _all_episodes(question, opened.base)
    all_members = [BaseEpisode.of(item) for item in everything if item.episode.attributes.num_replans]
    selected = {item.episode.name for item in question.selected}
    members = [member for member in all_members if member.name in selected]
    names = [episode.name for episode in opened.base.episodes]
    pairings = [pair_episodes(condition, members, names) for condition in opened.reruns]
    spread = _spread(opened, all_members, question.settings, dimensions)
    notes = [*opened.notes, *run_notes(question.episodes)]
    if not stores_executed(opened.base):
        notes.append("The base does not store how many steps of a chunk were executed: effects are over whole chunks.")
    groups = [condition.group for condition in opened.reruns if condition.group is not None]
    attention = group_attention(question, groups, everything) if groups else {}
    measured = _measured(pairings, members, spread, attention)
    drifts = _drifts(pairings, spread)
    unlike = (Kind.NOTHING, True)
    measured = [(one, rows) for one, rows in measured if (one.condition.kind, one.condition.recorded) != unlike]
    left_out = _left_out([pairing for pairing, rows in measured if not rows.height])
    if not any(rows.height for _, rows in measured) and not opened.rollouts:
        if any(pairing.condition.recorded for pairing in pairings):
            said = " ".join(drifts) or "None was measured in a selected replan."
            raise BadArgument(f"No effect that {opened.base.path} holds can be shown. {said}")
        raise BadArgument(f"No rerun of {opened.base.path} can be compared: {' '.join(left_out)}")
    notes += left_out
    pairings = [pairing for pairing, rows in measured if rows.height]
    opened = replace(opened, reruns=tuple(pairing.condition for pairing in pairings))
    episodes = pl.concat([pl.DataFrame(schema=_EPISODE_SCHEMA), *(rows for _, rows in measured)])
    rollouts = [rollout_pairs(condition, question) for condition in opened.rollouts]
    unpaired = [note for _, note in rollouts if note]
    return EffectStudy(
        analysis=analysis,
        given=opened,
        spread=spread,
        attention=attention,
        episodes=with_floors(episodes, opened.reruns),
        rollout_episodes=pl.concat([table for table, _ in rollouts])
        if rollouts
        else pl.DataFrame(schema=ROLLOUT_COLUMNS),
        notes=(*notes, *_notes(pairings, attention), *drifts, *unpaired),
        sums=sums_of_groups(question, members, spread, opened.reruns),
    )


def units_of_recorded(store: Store) -> ActionSpread:
    """The units of the effects that a store recorded, as `study_effects` has them: over all of its episodes.

    Raises:
        UserError: see `study_effects`.
    """
    opened = open_reruns(store, ())
    question = ask([store], AnalysisSettings())
    members = [BaseEpisode.of(item) for item in _all_episodes(question, store) if item.episode.attributes.num_replans]
    return _spread(opened, members, question.settings, None)


def _all_episodes(question: Question, base: Store) -> list[SelectedEpisode]:
    """All episodes of the base, selected or not; with `skip_corrupt`, damaged ones are left out."""
    known = {item.episode.name: item for item in question.selected}
    selected = []
    for episode in base.episodes:
        try:
            if episode.name in known:
                selected.append(known[episode.name])
                continue
            episode.read("actions")
            selected += load_tokens([(base, episode)], question.site)
        except CorruptEpisode:
            if not question.settings.skip_corrupt:
                raise
    return selected


def _left_out(pairings: Sequence[Pairing]) -> list[str]:
    """Why conditions without any compared replan are left out: a sentence for each reason."""
    reruns = [pairing for pairing in pairings if not pairing.condition.recorded]
    elsewhere = [pairing.condition.name for pairing in reruns if not pairing.pairs]
    empty = [pairing.condition.name for pairing in reruns if pairing.pairs]
    recorded = [one.condition for one in pairings if one.condition.recorded]
    never = [condition.name for condition in recorded if condition.kind != Kind.NOTHING]
    reasons = (
        (never, "not measured in any selected replan."),
        (elsewhere, "none of the selected episodes was run again."),
        (empty, "in the replans that are compared, the group has no key in the base."),
    )
    return [
        f"{listing(names)} {'is' if len(names) == 1 else 'are'} left out: {reason}"
        for names, reason in reasons
        if names
    ]


def _spread(
    opened: BaseAndReruns,
    members: Sequence[BaseEpisode],
    settings: AnalysisSettings,
    dimensions: Sequence[int] | None,
) -> ActionSpread:
    """The units, and which dimensions are compared. `members`: every episode of the base.

    Neither changes with --tasks. With `skip_corrupt`, episodes of reruns with damaged actions are left out.
    """
    base = opened.base
    number = members[0].actions.shape[2]
    for dimension in dimensions or ():
        if not 0 <= dimension < number:
            raise BadArgument(
                f"There is no dimension {dimension} of the action; the actions of {base.path} have the dimensions 0 to "
                f"{number - 1}."
            )
    spread = action_spread([member.actions for member in members], dimensions)
    if not spread.used.any():
        which = f"the dimensions {listing(dimensions)} of the actions" if dimensions else "the actions"
        raise BadArgument(
            f"In {base.path}, {which} are the same in every replan and step, so a change has no unit; give a base that "
            "moves, or other --dimensions."
        )
    pairs = []
    for condition in opened.reruns:
        repeated = {episode.name: episode for episode in condition.store.episodes if condition.kind == Kind.NOISE}
        for member in members:
            try:
                if member.name in repeated:
                    others = actions_of(member, repeated[member.name], condition)
                    measured = np.isfinite(others).all(axis=(1, 2))
                    if measured.any():
                        pairs.append((member.actions[measured], others[measured]))
            except CorruptEpisode:
                if not settings.skip_corrupt:
                    raise
    if not pairs:
        return spread
    return with_noise(spread, noise_of(pairs, spread.spread), leave_out=dimensions is None)


def _measured(
    pairings: Sequence[Pairing],
    members: Sequence[BaseEpisode],
    spread: ActionSpread,
    attention: dict[Any, GroupAttention],
) -> list[tuple[Pairing, pl.DataFrame]]:
    """The rows of each condition, without floors: those of reruns by rerun, the recorded ones by episode."""
    rows: dict[str, list[_Row]] = {pairing.condition.name: [] for pairing in pairings}

    def attention_to(condition: Condition, base: BaseEpisode) -> NDArray[np.float64] | None:
        return None if condition.group is None else attention[condition.group].values.get(base.name)

    for condition, pairs in ((one.condition, one.pairs) for one in pairings if not one.condition.recorded):
        measure = partial(_rows_of_pair, condition=condition, spread=spread)
        given = [(base, rerun, attention_to(condition, base)) for base, rerun in pairs]
        rows[condition.name] += [row for part in map_episodes(measure, given) for row in part]
    recorded = [pairing.condition for pairing in pairings if pairing.condition.recorded]
    if recorded:
        of_episode = partial(_rows_of_recorded, conditions=recorded, spread=spread)
        members_given = [(base, [attention_to(condition, base) for condition in recorded]) for base in members]
        for part in map_episodes(of_episode, members_given):
            for condition, some in zip(recorded, part, strict=True):
                rows[condition.name] += some
    return [(one, pl.DataFrame(rows[one.condition.name], schema=_EPISODE_SCHEMA)) for one in pairings]


def _rows_of_recorded(
    given: tuple[BaseEpisode, list[NDArray[np.float64] | None]], conditions: Sequence[Condition], spread: ActionSpread
) -> list[list[_Row]]:
    """The rows of one episode for each recorded condition."""
    base, attention = given
    changes = changes_recorded(base)
    return [
        _rows_of_pair((base, base.item.episode, of_group), condition, spread, changes)
        for condition, of_group in zip(conditions, attention, strict=True)
    ]


def _rows_of_pair(
    given: tuple[BaseEpisode, StoredEpisode, NDArray[np.float64] | None],
    condition: Condition,
    spread: ActionSpread,
    recorded: NDArray[np.float64] | None = None,
) -> list[_Row]:
    """The rows of one episode: of the base, its rerun, and the base's attention (replan, measure) to the group.

    recorded: the changes that were recorded beside the base's calls, for a recorded condition.
    """
    base, rerun, attention = given
    group = condition.group
    actions = actions_of(base, rerun, condition, recorded)
    changes = changes_of(base, actions, spread)
    measured = np.isfinite(actions).all(axis=(1, 2))
    has_keys = _has_keys(attention, len(changes), condition.kind) & measured
    if not has_keys.any():
        return []
    changes[~has_keys] = np.nan
    values = {name: changes[:, i] for i, name in enumerate(CHANGES)}
    if attention is not None:
        values |= {name: np.where(measured, attention[:, i], np.nan) for i, name in enumerate(MEASURES)}
    attributes = base.item.episode.attributes
    named = {
        "suite": base.item.store.suite,
        "task_id": attributes.task_id,
        "instruction": visible(attributes.instruction),
        "episode_index": attributes.episode_index,
        "condition": condition.name,
        "kind": condition.kind.value,
        "group": None if group is None else condition.group_name,
        "selector": None if group is None else group.text,
        "num_replans": int(has_keys.sum()),
    }
    return [{**named, **row} for row in mean_over_phases(base, values)]


def _has_keys(attention: NDArray[np.float64] | None, replans: int = 1, kind: Kind = Kind.WITHOUT) -> NDArray[np.bool_]:
    """Replans (replan,) in which a group has keys in the base: a word is in some instructions only.

    Where it has none nothing was changed, and the effect is not 0 but missing. Of a group that covers less than half a
    patch, the random control has no key: they are counted in whole keys.
    """
    if attention is None:
        return np.ones(replans, dtype=bool)
    keys = attention[:, MEASURES.index("keys")]
    return keys >= 0.5 if kind == Kind.RANDOM else keys > 0


def _notes(pairings: Sequence[Pairing], attention: dict[Any, GroupAttention]) -> list[str]:
    """Which episodes have no partner, and which inputs could not be compared.

    A series lacks the episodes with a replan without a key of its group. Conditions with the same gaps share a note.
    """
    names: dict[str, list[str]] = {}
    for pairing in pairings:
        condition, gaps = pairing.condition, []
        if condition.recorded:  # what an episode has no word or object for was not measured there
            continue
        known = attention[condition.group].values if condition.group is not None else {}
        empty = [name for name in pairing.missing if name in known and not _has_keys(known[name]).all()]
        kept = replace(pairing, missing=tuple(name for name in pairing.missing if name not in empty))
        if kept.gap:
            gaps.append(kept.gap)
        held = (
            held_by_one(base.item.store, base.item.episode, condition.store, rerun) for base, rerun in pairing.pairs
        )
        unknown = list(dict.fromkeys(name for one in held for name in one))
        if unknown:
            gaps.append(f"was not compared with the base in the {listing(unknown)}, which one of the two stores lacks")
        for gap in gaps:
            names.setdefault(gap, []).append(condition.name)
    return [
        f"{conditions[0]} {gap}."
        if len(conditions) == 1
        else f"Each of {len(conditions)} conditions ({listing(conditions, 3)}) {gap}."
        for gap, conditions in names.items()
    ]


def _drifts(pairings: Sequence[Pairing], spread: ActionSpread) -> list[str]:
    """How far unchanged reruns are from the base's actions, a sentence for each that is not equal to them."""
    notes = []
    for pairing in pairings:
        if pairing.condition.kind != Kind.NOTHING:
            continue
        largest, where = 0.0, ""
        for base, rerun in pairing.pairs:
            changes = changes_of(base, actions_of(base, rerun, pairing.condition), spread)
            chunks = np.nan_to_num(changes[:, CHANGES.index("effect_chunk")])
            if chunks.max() > largest:
                largest, where = float(chunks.max()), f"replan {int(chunks.argmax())} of {base.name}"
        # Calls made together differ by rounding from the call that the robot executed.
        if largest > (_MOST_ROUNDING if pairing.condition.recorded else 0.0):
            notes.append(
                f"{pairing.condition.name} changes nothing, and its actions are not those of the base: they differ by "
                f"up to {format_number(largest)} of their spread ({where}). Effects that are not far above that are "
                "none."
            )
    return notes
