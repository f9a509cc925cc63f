"""What every result says of its run first, what it notes beside its numbers, columns and phrases that several share."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.result import Column
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.measures.task_families import unknown_families
from vla_attention.analyze.statistics.intervals import says_a_size
from vla_attention.analyze.statistics.units import FEWEST_FAMILIES, Units
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.stores.store_format import CALLERS_MODULES, RootAttributes

#: With fewer units than these, an interval about other tasks covers less where these are skewed.
_FEW = 10
#: What untrained weights mean for every number.
UNTRAINED = "The weights are untrained (random): the numbers show that the pipeline works, and nothing about a policy."
GROUP_COLUMNS = (
    Column("group", "text"),
    Column("fraction", "percent", "of the attention", "part of the attention to all groups"),
    Column(
        "lift", "factor", "times even", "attention per token, over what it would be if spread evenly over all tokens"
    ),
    Column("keys", "number", "tokens"),
)
RATIO_COLUMNS = (
    Column(
        "geometric_mean",
        "factor",
        "ratio",
        "attention to one side over the other, geometric mean over layers, calls and tasks",
    ),
    Column("uniform_ratio", "number", "if even", "the ratio if attention were spread evenly over all tokens"),
    Column("ratio_lift", "factor", "per token", "ratio / ratio if even"),
)


def about(question: Question) -> list[str]:
    """Policy, suite and episodes solved in one line; then what was changed in the run, and untrained weights."""
    policy = question.stores[0].attributes.policy
    suites = listing(dict.fromkeys(store.suite for store in question.stores), 4)
    outcomes = [item.episode.attributes.success for item in question.selected]
    again = all(store.attributes.rerun_of is not None for store in question.stores)
    where = " in the run whose policy calls were made again" if again else ""
    line = f"{policy.name} on {suites}: {solved(outcomes, question.num_tasks)}{where}."
    return [line, *question.told, *([UNTRAINED] if question.untrained else [])]


def solved(outcomes: Iterable[bool | None], num_tasks: int) -> str:
    """`34 of 34 episodes of 17 tasks solved`; where no outcome is known, that; and how many are not known."""
    given = list(outcomes)
    known = [outcome for outcome in given if outcome is not None]
    tasks = "" if num_tasks == 1 else f" of {num_tasks} tasks"
    if not known:
        return f"{plural(len(given), 'episode')}{tasks}, outcomes not known"
    rest = len(given) - len(known)
    text = f"{sum(known)} of {plural(len(known), 'episode')}{tasks} solved"
    return f"{text}; of {rest} more the outcome is not known" if rest else text


def notes(question: Question) -> list[str]:
    """Which attention the numbers are of, what was left out, and what intervals are about."""
    labels = question.selection.layer_labels
    recorded = question.stores[0].attributes.recording_of(question.site).layers
    every = len(set(question.selection.blocks)) == len(recorded)
    which = "mean over all layers" if every else f"layer{'s' * (len(labels) > 1)} {listing(labels, 40)}"
    root = question.stores[0].attributes
    others = [other.name for other in root.sites if other.name != question.site]
    return [
        f"Site '{question.site}', {which}. Intervals: {_held(question.units)}, about {question.units.words}.",
        *(remark for remark in question.remarks if remark not in question.told),
        *filter(None, [question.selection.note, without_a_side(root, question.site), unknown_families(
            question.sampling, question.selected)]),
        *([f"Of site '{question.site}' only; {listing(others)} are softmaxes of their own: choose by --site, and never "
           "divide a mass of one by a mass of another."] if others else []),
    ]  # fmt: skip


def _held(units: Units) -> str:
    """How often intervals hold the truth: `benchmarks/interval_coverage.py --only remedies` has the numbers."""
    few = units.estimand.of_other_tasks and len(np.unique(units.clusters)) < _FEW
    return "95% (about 90% if some of so few differ much from the rest)" if few else "95%"


def how_to_record_effects(question: Question) -> str:
    """What records effects of words, pictures and other sentences: a command, or code where the caller loads it."""
    store = question.stores[0]
    if store.attributes.policy.checkpoint_format == CALLERS_MODULES:
        return 'va.record(..., effects="text,cameras"), with replan(repeat=lambda call: ...)'
    return f"vla-attention capture rerun {shlex.quote(str(store.path))} --effects text,cameras --prompts standard"


def only(question: Question, episodes: pl.DataFrame) -> Question:
    """The question about the episodes in a table, by `EPISODE_ID`; about all where the table is empty."""
    wanted = set(episodes.select(EPISODE_ID).iter_rows())
    left = [item for item in question.selected if item.key in wanted]
    return replace(question, selected=tuple(left) or question.selected)


def out_of(part: Question, question: Question) -> str:
    """`2 of 6 episodes (1 of 3 tasks)`; empty where the part is all."""
    if len(part.selected) == len(question.selected):
        return ""
    episodes, tasks = plural(len(question.selected), "episode"), plural(question.num_tasks, "task")
    return f"{len(part.selected)} of {episodes} ({part.num_tasks} of {tasks})"


def without_a_side(root: RootAttributes, site: str) -> str:
    """That a site of some of the blocks has no image keys or no text keys, as a sentence; empty where it has both."""
    kinds = {span.kind for span in root.site(site).spans}
    missing = [name for name, has in (("image", {"image", "latent"}), ("text", {"text"})) if not kinds & has]
    if not missing or not root.site(site).layers:
        return ""
    return (
        f"Site '{site}' has no {' and no '.join(missing)} tokens: a ratio of visual to linguistic attention is not "
        "defined inside of it. Compare norms of contributions, which sites of different blocks share."
    )


def enough(question: Question) -> str:
    """Whether the data suffice to say something about other episodes and tasks, as a sentence; empty where they do."""
    episodes, tasks = len(question.selected), question.num_tasks
    if episodes == 1:
        return "One episode shows nothing about others: there is no interval."
    if tasks == 1:
        return f"One task of {episodes} episodes: the numbers show nothing about other tasks."
    units = question.units
    if units.estimand.of_other_tasks:
        return ""
    families = question.sampling.units(question.tasks).num_families
    if families is None or families >= FEWEST_FAMILIES:
        return ""
    kinds = "one kind" if families == 1 else f"{families} kinds"
    which = f"The {tasks} tasks are of {kinds} (sentences of one template)"
    return f"{which}: the numbers are about these tasks, not about others."


def sides(grouping: Grouping) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The groups on both sides of the ratio."""
    assert grouping.ratio is not None
    return grouping.ratio.numerator, grouping.ratio.denominator


def inverse(value: float, low: float | None, high: float | None) -> list[float | None]:
    """1 / value with its interval."""
    return [1 / value, None if high is None else 1 / high, None if low is None else 1 / low]


def with_interval(row: Mapping[str, Any], name: str) -> str:
    """`2.89 [2.13, 3.93]`; the value alone without an interval, and where the ends of a ratio's are worlds apart."""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    if low is None:
        return f"{row[name]:.3g}"
    if not says_a_size(low, high):
        return f"{row[name]:.3g} (no interval: too few episodes for how they differ)"
    return f"{row[name]:.3g} [{low:.3g}, {high:.3g}]"


def would_show(factor: float | None) -> str:
    """What a run of this size would have shown, as a sentence: of `Estimate.detectable` of a ratio; empty for None."""
    if factor is None or not math.isfinite(factor):
        return ""
    return f"A run of this size shows {factor:.3g} times, or {1 / factor:.2g} times, with a chance of 80%."
