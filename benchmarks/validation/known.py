"""Question 1: which of the printed numbers tell policies apart whose dependence is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import vla_attention as va
from benchmarks.validation.calls import NOTHING, changed_episodes
from benchmarks.validation.changes import BASE_CAMERA, WRIST_CAMERA, colour_word, known_changes, named_object
from benchmarks.validation.policies import KnownPolicy
from benchmarks.validation.tables import SCALES, means
from vla_attention.analyze.core.action_changes import ActionSpread
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import Store


@dataclass(frozen=True)
class Number:
    """A number that this tool prints. sign: 1 where the policy that depends should have more of it, -1 less."""

    title: str
    about: str
    sign: int = 1
    scale: str = "log"


READ, WRIST, MARK, OTHER = "reading", "the wrist camera", "the mark", "other"
NUMBERS: dict[str, Number] = {
    "ratio": Number("ratio", READ, -1),
    "ratio_lift": Number("lift of the ratio", READ, -1),
    "ratio_lift_instruction": Number("lift of the ratio, grouping `instruction`", READ, -1),
    "ratio_lift_without_sinks": Number("lift of the ratio without sinks", READ, -1),
    "contribution_ratio": Number("ratio of contributions", READ, -1),
    "contribution_lift": Number("lift of the ratio of contributions", READ, -1),
    "instruction_mass": Number("mass of the instruction's words", READ),
    "instruction_lift": Number("lift of the instruction's words", READ),
    "colour_lift": Number("lift of the colour's word", READ),
    "verb_lift": Number("lift of the verb", READ),
    "without_linguistic": Number("effect without linguistic keys", READ, scale="plain"),
    "only_visual": Number("effect with pictures alone", READ, scale="plain"),
    "without_instruction": Number("effect without the instruction's words", READ, scale="plain"),
    "without_instruction_all": Number("... for all queries", READ, scale="plain"),
    "instruction_beyond": Number("effect without the instruction's words, minus random keys", READ, scale="plain"),
    "without_colour": Number("effect without the colour's word", READ, scale="plain"),
    "without_colour_all": Number("... for all queries", READ, scale="plain"),
    "without_verb": Number("effect without the verb", READ, scale="plain"),
    "prompt_empty": Number("effect of an empty prompt", READ, scale="plain"),
    "prompt_other_colour": Number("effect of another colour in the prompt", READ, scale="plain"),
    "wrist_mass": Number("mass of the wrist camera", WRIST),
    "wrist_lift": Number("lift of the wrist camera", WRIST),
    "without_wrist": Number("effect without the wrist camera's keys", WRIST, scale="plain"),
    "without_wrist_all": Number("... for all queries", WRIST, scale="plain"),
    "wrist_beyond": Number("effect without the wrist camera's keys, minus random keys", WRIST, scale="plain"),
    "wrist_blank": Number("effect of a blank wrist camera", WRIST, scale="plain"),
    "mark_enrichment": Number("enrichment of the mark", MARK),
    "without_mark": Number("effect without the mark's keys", MARK, scale="plain"),
    "without_mark_all": Number("... for all queries", MARK, scale="plain"),
    "mark_filled": Number("effect of a picture without the mark", MARK, scale="plain"),
    "named_enrichment": Number("enrichment of the named cube", OTHER),
    "without_named": Number("effect without the named cube's keys", OTHER, scale="plain"),
    "without_visual": Number("effect without pictures", OTHER, scale="plain"),
    "without_base": Number("effect without the agent camera's keys", OTHER, scale="plain"),
    "base_blank": Number("effect of a blank agent camera", OTHER, scale="plain"),
    "noise": Number("noise floor: another seed", OTHER, scale="plain"),
    "random_instruction": Number("floor: as many random keys as the instruction", OTHER, scale="plain"),
    "random_colour": Number("floor: one random key", OTHER, scale="plain"),
    "random_wrist": Number("floor: as many random keys as the wrist camera", OTHER, scale="plain"),
}
#: What is compared: the control that depends, the one that does not, and the numbers' subject.
CONTRASTS = (
    ("words", "mark", READ),
    ("words", "redundant", READ),
    ("words", "no-wrist", WRIST),
    ("mark", "redundant", MARK),
)
#: Effects beyond those of as many random keys: name -> the effect and its control.
_BEYOND = {
    "instruction_beyond": ("without_instruction", "random_instruction"),
    "wrist_beyond": ("without_wrist", "random_wrist"),
}
_ID = ["suite", "task_id", "episode_index"]


def attention_numbers(store: Store) -> Iterator[pl.DataFrame]:
    """Tables of suite, task_id, episode_index, number, value: what `vla-attention` says of each episode's attention."""
    run = va.open(store.path)
    overall = pl.col("layer") == "layers_avg"

    def of(table: pl.DataFrame, number: str, value: str) -> pl.DataFrame:
        chosen = table.select(*_ID, pl.lit(number).alias("number"), pl.col(value).cast(pl.Float64).alias("value"))
        return chosen.with_columns(pl.col("task_id").cast(pl.Int64), pl.col("episode_index").cast(pl.Int64))

    ratios = run.analyze()["episodes"].filter(overall)
    yield of(ratios, "ratio", "geometric_mean")
    yield of(ratios, "ratio_lift", "ratio_lift")
    own = {"grouping": "instruction"}
    yield of(run.analyze(**own)["episodes"].filter(overall), "ratio_lift_instruction", "ratio_lift")
    words = run.analyze(**own)["episodes_groups"].filter(overall, group="linguistic")
    yield of(words, "instruction_mass", "mass")
    yield of(words, "instruction_lift", "lift")
    cleaned = run.analyze(without_sinks="")["episodes"].filter(overall)
    yield of(cleaned, "ratio_lift_without_sinks", "ratio_lift")
    norms = run.analyze()["contributions_steps"].with_columns(pl.col("contribution_ratio", "ratio_lift").log())
    episodes = norms.group_by(_ID, maintain_order=True).agg(pl.col("contribution_ratio", "ratio_lift").mean().exp())
    yield of(episodes, "contribution_ratio", "contribution_ratio")
    yield of(episodes, "contribution_lift", "ratio_lift")
    wrist = run.analyze(grouping="cameras")["episodes_groups"].filter(overall, group=WRIST_CAMERA)
    yield of(wrist, "wrist_mass", "mass")
    yield of(wrist, "wrist_lift", "lift")
    wanted = pl.DataFrame(
        [
            (
                store.attributes.protocol.suite,
                episode.attributes.task_id,
                episode.attributes.episode_index,
                colour_word(episode),
                episode.attributes.instruction.split()[0],
                named_object(episode),
            )
            for episode in store.episodes
        ],
        schema={**dict.fromkeys(["suite"], pl.String), "task_id": pl.Int64, "episode_index": pl.Int64}
        | dict.fromkeys(["colour", "verb", "named"], pl.String),
        orient="row",
    )
    read = run.words()["words_episodes"].filter(overall).join(wanted, on=_ID)
    yield of(read.filter(pl.col("item") == pl.col("colour"), kind="word"), "colour_lift", "lift")
    if wanted["colour"].is_not_null().any():
        yield of(read.filter(kind="place", place=0), "verb_lift", "lift")
    seen = run.objects(iou=False)["objects_episodes"].filter(overall, kind="object").join(wanted, on=_ID)
    yield of(seen.filter(pl.col("item") == pl.col("named"), camera="all"), "named_enrichment", "enrichment")
    yield of(seen.filter(item="mark", camera=BASE_CAMERA), "mark_enrichment", "enrichment")


def effect_numbers(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> tuple[pl.DataFrame, float]:
    """The same table of effects, and how far unchanged calls are from the stored ones, in units of the spread."""
    suite = store.attributes.protocol.suite
    rows, furthest = [], 0.0
    for episode in changed_episodes(policy, store, known_changes, replans, folder, say):
        values = {name: float(np.mean(episode.effect(name, spread))) for name in episode.actions}
        values |= {name: values[group] - values[control] for name, (group, control) in _BEYOND.items()}
        for name, value in values.items():
            if name == NOTHING:
                furthest = max(furthest, value)
            elif name in NUMBERS:
                rows.append((suite, episode.task_id, episode.episode_index, name, value))
    schema = {
        "suite": pl.String,
        "task_id": pl.Int64,
        "episode_index": pl.Int64,
        "number": pl.String,
        "value": pl.Float64,
    }
    return pl.DataFrame(rows, schema=schema, orient="row"), furthest


def known_numbers(policies: Sequence[KnownPolicy], tables: Mapping[str, pl.DataFrame]) -> list[dict[str, Any]]:
    """Means of every number of every policy with intervals over tasks."""
    found = []
    for policy in policies:
        if policy.name not in tables:
            continue
        for scale in ("log", "plain"):
            names = [name for name, number in NUMBERS.items() if number.scale == scale]
            rows = means(tables[policy.name].filter(pl.col("number").is_in(names)), ["number"], scale=scale)
            found += [{"policy": policy.name, "control": policy.control, "seed": policy.seed} | row for row in rows]
    return found


def contrasts(policies: Sequence[KnownPolicy], tables: Mapping[str, pl.DataFrame]) -> list[dict[str, Any]]:
    """For every contrast and number: in how many pairs of trained policies the difference has the expected sign.

    Policies are paired by task and initial state; a pair counts where the interval over tasks excludes no difference.
    """
    found = []
    for (first, other, about), (name, number) in product(CONTRASTS, NUMBERS.items()):
        if number.about != about:
            continue
        firsts = [policy for policy in policies if policy.control == first]
        others = [policy for policy in policies if policy.control == other]
        right = wrong = pairs = 0
        for one, two in product(firsts, others):
            sign = _sign(tables[one.name], tables[two.name], name, number)
            if sign is None:
                continue
            pairs += 1
            right, wrong = right + (sign == number.sign), wrong + (sign == -number.sign)
        if firsts and others:
            verdict = (
                "-" if not pairs else "separates" if right == pairs else "wrong way" if wrong == pairs else "does not"
            )
            row = {"contrast": f"{first}/{other}", "number": name, "pairs": pairs, "expected": right, "wrong": wrong}
            found.append(row | {"verdict": verdict})
    return found


def _sign(first: pl.DataFrame, other: pl.DataFrame, name: str, number: Number) -> int | None:
    """Sign of first minus other where the interval over tasks excludes 0, else 0; None where one has no such number."""
    place = ["task_id", "episode_index"]
    into = SCALES[number.scale][0]
    both = first.filter(number=name).join(other.filter(number=name), on=place, suffix="_other")
    if both.height < 2:
        return None
    difference = into(both["value"].to_numpy()) - into(both["value_other"].to_numpy())
    rows = means(both.with_columns(pl.Series("difference", difference), pl.lit(name).alias("of")), ["of"], "difference")
    if not rows or rows[0]["low"] is None:
        return 0
    return 1 if rows[0]["low"] > 0 else -1 if rows[0]["high"] < 0 else 0


def all_numbers(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> tuple[pl.DataFrame, float]:
    """Attention and effects of one policy; numbers that its store has not are left out."""
    parts = []
    try:
        parts += list(attention_numbers(store))
    except UserError as error:
        say(f"{store.path}: {error}")
    effects, furthest = effect_numbers(policy, store, spread, folder, replans, say)
    return pl.concat([*parts, effects]), furthest
