"""The answer in a few sentences: how much the action changes without what is seen, and without what is read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vla_attention.analyze.effects.conditions import FLOORS, Kind
from vla_attention.analyze.effects.effect_study import EffectStudy
from vla_attention.analyze.effects.group_rows import GroupRow, group_rows, readers_of
from vla_attention.analyze.effects.item_rows import MODALITIES, ItemRow, item_rows, ratio_of_effects
from vla_attention.analyze.effects.over_time import shares_of_dimensions
from vla_attention.analyze.measures.alignment import GRIPPER
from vla_attention.analyze.show.findings import findings
from vla_attention.analyze.show.numbers import format_interval, format_number, row_interval
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.interventions import readers
from vla_attention.schemas.stores.store_format import CALLERS_MODULES

#: Sentences that name conditions after looking at all: beyond noise, and beyond random keys.
_SENTENCES = 2
_ACTION, _ALL = readers("action"), readers("all")
#: What a knockout leaves, by for whom it is.
_REACH = {
    _ACTION: " alone (what other keys took over from them still reaches the action)",
    _ALL: " (no other key can carry them on)",
}


def answer_lines(study: EffectStudy) -> list[str]:
    """The sentences, each to be wrapped by itself."""
    if not study.conditions:
        return ["No rerun was given, only rollouts: there are no effects on single actions."]
    if study.is_recorded and (items := item_rows(study)):
        return item_lines(study, items)
    grouping, rows = study.analysis.grouping, group_rows(study)
    # Where a site has one of the modalities only (Cosmos), the grouping has no ratio.
    sides = MODALITIES if grouping.ratio is None else (*grouping.ratio.numerator, *grouping.ratio.denominator)
    lines = [noise_sentence(study)]
    lines += [side_sentence(row) for name in sides for row in rows if row.name == name]
    lines.append(for_whom(rows))
    lines += attention_line(study)
    lines.append(beyond(study, "minus_noise", "an effect beyond the noise"))
    return lines


def item_lines(study: EffectStudy, items: Sequence[ItemRow]) -> list[str]:
    """The sentences about effects that were recorded: which word decides, by which way, and how much pictures do."""
    return [*word_lines(study, items), *side_lines(study, items)]


def word_lines(study: EffectStudy, items: Sequence[ItemRow]) -> list[str]:
    """Which word decides, by which way, what attention says, and what another noise seed does."""
    words = [item for item in items if item.kind == "word"]
    of_words = [_deciding(words), mostly_one_dimension(study, words[0]), _unlike_attention(words)] if words else []
    return [line for line in (*of_words, noise_sentence(study)) if line]


def side_lines(study: EffectStudy, items: Sequence[ItemRow]) -> list[str]:
    """Pictures against text, and which items exceed the noise."""
    lines = [_ratios(study)]
    known = [item for item in items if item.strongest["minus_noise"] is not None]
    if known:
        q_values = [1.0 if item.strongest["minus_noise"] <= 0 else item.strongest["minus_noise_q"] for item in known]
        names = [item.name for item in known]
        lines.append(findings(q_values, names, "item", "an effect beyond the noise", _SENTENCES))
    return [line for line in lines if line]


def _ratios(study: EffectStudy) -> str:
    """Pictures against text by effect, and the same replans' ratios of attention and of contributions beside it."""
    ratio, said = ratio_of_effects(study), ""
    if ratio is not None and ratio["ratio"] is not None:
        said = (
            f"Without all pictures the action changes {format_number(ratio['ratio'])}{_interval(ratio, 'ratio')} times "
            f"as much as without all text ({format_number(ratio['visual'])} and {format_number(ratio['linguistic'])})."
        )
    headline, rows = study.analysis.headline, study.analysis.contribution_rows
    sides = study.analysis.grouping.ratio
    if sides is None or (*sides.numerator, *sides.denominator) != MODALITIES:
        return " ".join([said, *attention_line(study)]).lstrip()
    if headline is None or headline.value is None:
        return said
    bounds = format_interval(headline.low, headline.high)
    said += f" Their attention: {format_number(headline.value)}{'' if bounds == '-' else f' {bounds}'} times as much"
    said += f", uniform attention's {format_number(headline.uniform)}" if headline.uniform is not None else ""
    if rows is not None:
        row = rows.row(-1, named=True)
        said += f"; norms of contributions: {format_number(row['geometric_mean'])}{_interval(row, 'geometric_mean')}"
    measured, every = study.measured[0], study.analysis.overall["num_episodes"]
    return f"{said.lstrip()}{f' (all {every} episodes, effects in {measured})' if measured < every else ''}."


def _deciding(words: Sequence[ItemRow]) -> str:
    """The word with the largest effect, and by which way the words with large effects reach the action."""
    first = words[0]
    total = "total" in first.by_reader
    said = f"{first.name} has the largest effect of {plural(len(words), 'word')}: "
    said += f"{'without it' if total else 'hidden from the action queries,'} the action changes by "
    said += f"{_effect(first.strongest)} of its spread."
    # Every word beyond the noise: the largest effect may be one that each task has, and another word may choose.
    large = [word for word in words if (word.strongest["minus_noise"] or 0.0) > 0]
    if not large:
        effect, beyond_noise = first.strongest["effect"], first.strongest["minus_noise"]
        if beyond_noise is None:
            return said
        more = "more, by" if beyond_noise < -effect / 10 else "as much,"
        return f"{said} Another noise seed changes it {more} {format_number(effect - beyond_noise)}."
    large = [word for word in large if {"total", "direct"} <= set(word.by_reader)]
    own = [word for word in large if _at_least_half(word.effect("direct"), word.effect("total"))]
    others = [word for word in large if word not in own]
    through = [word for word in others if _at_least_half(word.effect("pictures"), word.effect("total"))]
    parts = [f"the action queries read {_names(own)} themselves"] if own else []
    if through:
        them = "it" if len(through) == 1 else "them"
        parts.append(f"{_names(through)} {_reach(through)} the action through the pictures, which have read {them}")
    if rest := [word for word in others if word not in through]:
        parts.append(f"{_names(rest)} {_reach(rest)} the action through other tokens")
    if others:
        amounts = sorted(word.effect("direct") or 0.0 for word in others)
        span = format_number(amounts[0]) + (f" to {format_number(amounts[-1])}" if len(amounts) > 1 else "")
        these = "that one changes" if len(others) == 1 else "these change"
        parts.append(f"hidden from the action queries alone, {these} it by {span}")
    text = "; ".join(parts)
    return f"{said} {text[:1].upper()}{text[1:]}." if text else said


#: So much of a squared effect in one dimension is said: the size is then that of this dimension's unit.
_MOST_OF_IT = 0.8


def mostly_one_dimension(study: EffectStudy, item: ItemRow) -> str:
    """That an effect is nearly all in one dimension of the action, with what the movement does; empty where not."""
    row = item.strongest
    shares = shares_of_dimensions(study, row["condition"])
    used = study.spread.used.sum()
    if used < 2 or shares.max(initial=0.0) < _MOST_OF_IT:
        return ""
    dimension = int(shares.argmax())
    known = row["angle"] is not None
    gripper = " (the gripper)" if known and dimension == len(shares) + GRIPPER else ""
    said = (
        f"Of this, {shares[dimension]:.0%} is dimension {dimension}{gripper} of the action, whose spread in this store "
        f"is {format_number(study.spread.spread[dimension])}: "
    )
    others = " ".join(str(i) for i in np.flatnonzero(study.spread.used) if i != dimension)
    if known:
        said += (
            f"the gripper's command is reversed in {row['gripper_flips']:.0%} of the steps, and the movement turns by "
            f"{format_number(row['angle'])} degrees. "
        )
    return f"{said}Without that dimension: --dimensions {others}."


def _at_least_half(part: float | None, whole: float | None) -> bool:
    return part is not None and whole is not None and part >= whole / 2


def _names(words: Sequence[ItemRow]) -> str:
    return listing([word.name for word in words], 8)


def _reach(words: Sequence[ItemRow]) -> str:
    return "reaches" if len(words) == 1 else "reach"


def _effect(row: dict[str, Any]) -> str:
    return f"{format_number(row['effect'])}{_interval(row, 'effect')}"


def _unlike_attention(words: Sequence[ItemRow]) -> str:
    """Words whose attention says something else than their effect."""
    silent = [
        f"{word.name} ({format_number(row['lift'])})"
        for word in words
        if (row := word.strongest)["lift"] is not None and row["lift"] < 1 and _shown(row, "minus_noise")
    ]
    idle = [
        f"{word.name} ({format_number(row['lift'])})"
        for word in words
        if (row := word.strongest)["lift"] is not None
        and row["lift"] > 1
        and row["minus_noise_q"] is not None
        and not _shown(row, "minus_noise")
    ]
    parts = []
    if silent:
        parts.append(f"Less attention than uniform, and an effect beyond the noise: {listing(silent, 6)}.")
    if idle:
        parts.append(f"More attention than uniform, and no effect shown beyond the noise: {listing(idle, 6)}.")
    return f"{' '.join(parts)} (In brackets: lift.)" if parts else ""


def _shown(row: dict[str, Any], floor: str) -> bool:
    """Whether an effect is shown to exceed its floor."""
    q = row[f"{floor}_q"]
    return bool(row[floor] is not None and row[floor] > 0 and q is not None and q <= NAMED_AT / _SENTENCES)


def attention_line(study: EffectStudy) -> list[str]:
    """The ratio of the base's attention, to stand beside the effects."""
    return []


def noise_sentence(study: EffectStudy) -> str:
    """What another noise seed does on the same inputs; every effect must exceed it."""
    rows = [study.of(condition) for condition in study.of_kind(Kind.NOISE)]
    if not rows:
        base = study.given.base
        said = "No rerun changes the noise seed alone, so nobody knows how much of an effect another noise would give"
        if base.attributes.protocol.name == "recorded":
            return f"{said}."
        command = f"rerun {base.path} --noise-seed 1"
        if base.attributes.policy.checkpoint_format == CALLERS_MODULES:
            command = f"replay ... --noise-seed 1 --rerun-of {base.path}"
        return f"{said}: make one with vla-attention capture {command}."
    texts = [f"{format_number(row['effect'])}{_interval(row, 'effect')}" for row in rows]
    return (
        f"Another noise seed on the same inputs changes the action by {', '.join(texts)} of its spread: a smaller "
        "effect cannot be told from chance."
    )


def for_whom(rows: Sequence[GroupRow]) -> str:
    """For whom the groups' keys were cut, and what that leaves; empty without a group."""
    readers_named = [readers for readers in readers_of(rows) if readers]
    if not readers_named:
        return ""
    if readers_named == [_ACTION]:
        return (
            f"Keys were cut for {_ACTION} alone: what other keys took over from them still reaches the action, and "
            f"does not where keys are cut for {_ALL} (--knockout-queries all)."
        )
    if len(readers_named) == 1:
        return f"Keys were cut for {readers_named[0]}{_REACH.get(readers_named[0], '')}."
    return f"Names say for whom keys were cut: for {'; for '.join(one + _REACH.get(one, '') for one in readers_named)}."


def side_sentence(row: GroupRow) -> str:
    """What the action does without a group, and with that group alone."""
    parts, name = [], row.label
    if row.without is not None:
        parts.append(f"Without {name} the action changes by {_amount(row.without)}{_verdict(row.without)}")
    if row.only is not None:
        start = f"with {name} alone" if parts else f"With {name} alone the action changes"
        parts.append(f"{start} by {_amount(row.only)}{_verdict(row.only)}")
    return f"{'; '.join(parts)}."


def _amount(row: dict[str, Any]) -> str:
    factor = row["over_noise"]
    times = f", {format_number(factor)} times the noise" if factor is not None else ""
    return f"{format_number(row['effect'])}{_interval(row, 'effect')}{times}"


def _verdict(row: dict[str, Any]) -> str:
    """Said where the effect is not shown to exceed its floor."""
    floors = []
    for name, what in (("minus_noise", "the noise"), ("minus_random", "random keys")):
        if row[name] is None:
            continue
        q = row[f"{name}_q"]
        if row[name] <= 0 or (q is not None and q > NAMED_AT / _SENTENCES):
            floors.append(f"not shown to exceed {what}")
        elif q is None:
            floors.append(f"no interval, so nobody knows whether it exceeds {what}")
    return f" ({'; '.join(floors)})" if floors else ""


def beyond(study: EffectStudy, name: str, what: str) -> str:
    """Which conditions exceed a floor (`minus_noise`, `minus_random`); empty where there is no such floor."""
    tested = [condition for condition in study.conditions if condition.kind not in (*FLOORS, Kind.NOTHING)]
    rows = [(condition.name, study.of(condition)) for condition in tested]
    rows = [(label, row) for label, row in rows if row[name] is not None]
    if not rows:
        return ""
    # An effect below its floor differs from it, but does not exceed it.
    q_values = [1.0 if row[name] <= 0 else row[f"{name}_q"] for _, row in rows]
    return findings(q_values, [label for label, _ in rows], "condition", what, _SENTENCES)


def _interval(row: dict[str, Any], name: str) -> str:
    bounds = row_interval(row, name)
    return "" if bounds == "-" else f" {bounds}"
