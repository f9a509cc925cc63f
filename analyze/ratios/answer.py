"""The answer in three sentences: what was run, the ratio beside that of uniform attention, what may be concluded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vla_attention.analyze.measures.aggregate import HEADLINE
from vla_attention.analyze.ratios.verdict import AS_UNIFORM, UNDECIDED, reading
from vla_attention.analyze.show.numbers import format_interval, format_number, interval_name, of_tasks, plural
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import listing

#: What the column `aggregate.HEADLINE` is called.
HEADLINE_NAME = "geometric mean"
#: With fewer episodes, or with one task, the third sentence says so.
FEW_EPISODES = 5


@dataclass(frozen=True)
class Headline:
    """The number that answers the question, and what it is compared with.

    Attributes:
        what: the two sides, as in `visual / linguistic`.
        name: which mean of the ratios it is, and over what.
        value: None where no replan has a finite ratio.
        low, high: bounds of its interval; None without one.
        about: what the interval is about: "tasks like these", "these tasks" ...
        uniform: the ratio of uniform attention; None where there is none.
        lift, lift_low, lift_high: ratio / ratio of uniform attention, with its interval; None without one.
        reading: what the ratio may be called, see `verdict.reading`.
    """

    what: str
    name: str
    value: float | None
    low: float | None
    high: float | None
    about: str
    uniform: float | None
    lift: float | None
    lift_low: float | None
    lift_high: float | None
    reading: str


def headline_of(row: Mapping[str, Any], what: str, name: str, about: str, untrained: bool) -> Headline:
    """The headline of a row with the columns of `aggregate.task_tables` on ratios; the other arguments: `Headline`."""
    return Headline(
        what=what,
        name=name,
        value=row[HEADLINE],
        low=row[f"{HEADLINE}_low"],
        high=row[f"{HEADLINE}_high"],
        about=about,
        uniform=row["uniform_ratio"],
        lift=row["ratio_lift"],
        lift_low=row["ratio_lift_low"],
        lift_high=row["ratio_lift_high"],
        reading=reading(row, untrained),
    )


def run_sentence(
    policy: str, row: Mapping[str, Any], solved: str, suites: list[str], layers: int, steps: tuple[int, ...], site: str
) -> str:
    """What was run: policy, episodes, tasks, outcomes in words (`solved`), and which attention was measured."""
    return (
        f"{policy} in {listing(suites, 4)}: {of_tasks(row['num_episodes'], row['num_tasks'])}, {solved}; "
        f"attention of the action queries at {plural(row['num_replans'], 'replan')}, {plural(layers, 'layer')}, "
        f"denoise {'step' if len(steps) == 1 else 'steps'} {listing(steps)}, site '{site}'."
    )


def ratio_sentence(headline: Headline) -> str:
    """The ratio with its interval beside that of uniform attention."""
    if headline.value is None:
        return f"No replan has a finite ratio {headline.what}."
    bounds = format_interval(headline.low, headline.high)
    interval = "no interval" if bounds == "-" else f"{interval_name(DEFAULT_LEVEL)} {bounds} about {headline.about}"
    ratio = f"The ratio {headline.what} is {format_number(headline.value)} ({headline.name}; {interval})"
    if headline.uniform is None:
        return f"{ratio}; there is no ratio of uniform attention to compare it with."
    lift = format_interval(headline.lift_low, headline.lift_high)
    return (
        f"{ratio}; uniform attention gives {format_number(headline.uniform)}, and the lift is "
        f"{format_number(headline.lift)}{'' if lift == '-' else f' {lift}'}."
    )


def conclusion(headline: Headline | None, untrained: bool, num_tasks: int, num_episodes: int) -> str:
    """What may be concluded from the headline, and what not; without one the grouping has no ratio."""
    if untrained:
        return (
            "The weights are untrained (random): the numbers show that the pipeline works, and nothing may be "
            "concluded about any policy."
        )
    limits = _limits(num_tasks, num_episodes)
    if headline is None:
        return f"The grouping has no ratio: read each group's fraction beside its lift (1: uniform attention).{limits}"
    if headline.value is None or headline.uniform is None or headline.lift is None:
        return f"Nothing may be concluded about looking or reading without a ratio and its baseline.{limits}"
    if headline.reading == UNDECIDED:
        return f"Without an interval, nobody knows whether it differs from uniform attention.{limits}"
    if headline.reading == AS_UNIFORM:
        return f"The lift's interval holds 1: the attention looks as uniform attention does.{limits}"
    above, _, below = headline.what.partition(" / ")
    more = "more" if headline.lift > 1 else "less"
    return (
        f"Against {below}, {above} gets {more} than uniform attention gives it; where a policy reads from does not "
        f"show what it would do without it.{limits}"
    )


def _limits(num_tasks: int, num_episodes: int) -> str:
    few = f" {num_episodes} episodes are few." if 1 < num_episodes < FEW_EPISODES else ""
    return (f" One task shows nothing about other tasks.{few}" if num_tasks == 1 else few) if num_episodes > 1 else ""
