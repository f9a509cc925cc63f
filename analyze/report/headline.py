"""The first section: the number, its interval, what uniform attention gives, and what to know before quoting it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from vla_attention.analyze.measures.frames import layer_name
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.verdict import verdict_sentence
from vla_attention.analyze.report.caveats import Caveat
from vla_attention.analyze.report.section_parts import Paragraph, Part, Section
from vla_attention.analyze.show.numbers import (
    format_interval,
    format_number,
    format_percent,
    format_percent_interval,
    interval_name,
    plural,
    solved_text,
)
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL

#: Boxes for fractions when the grouping has no ratio.
_MOST_FRACTIONS = 3


@dataclass(frozen=True)
class Box:
    """A large number with its name above it and a note below it."""

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Headline:
    """Grave caveats as banners, then the boxes."""

    template: ClassVar[str] = "headline.html"
    banners: Sequence[Caveat]
    boxes: Sequence[Box]


def headline_section(analysis: Analysis, notes: Sequence[Caveat]) -> Section:
    """The numbers over all selected tasks; `notes` are the caveats of this analysis."""
    row, ratio = analysis.overall, analysis.grouping.ratio
    boxes = _fraction_boxes(analysis) if ratio is None else _ratio_boxes(row, ratio.numerator, ratio.denominator)
    solved = solved_text(item.episode.attributes.success for item in analysis.question.selected)
    note = f"of {plural(row['num_tasks'], 'task')}; {solved}; "
    boxes.append(Box("episodes", str(row["num_episodes"]), note + plural(row["num_replans"], "replan")))
    parts: list[Part] = [Headline([caveat for caveat in notes if caveat.grave], boxes)]
    if ratio is not None:
        sentence = verdict_sentence(analysis.grouping, row, analysis.question.untrained)
        parts += [Paragraph(sentence)] if sentence else []
        other = [
            f"{name} {format_number(row[column])}"
            for name, column in (
                ("Ratio of means", "ratio_of_means"),
                ("mean of the episodes' mean ratios", "ratio_mean"),
            )
        ]
        other.append(f"median of the episodes {format_number(row['ratio_median'])}")
        if row["num_tasks"] > 1:
            other.append(f"intervals are about {analysis.question.units.words}")
        parts.append(Paragraph(f"{', '.join(other)}.", quiet=True))
    return Section("headline", "Headline", parts)


def _ratio_boxes(row: Mapping[str, Any], numerator: Sequence[str], denominator: Sequence[str]) -> list[Box]:
    name = " / ".join(shortened(" + ".join(side), 60) for side in (numerator, denominator))
    over = layer_name(row["layer"])
    if row["geometric_mean"] is None:
        ratio = Box(f"ratio {name}", "none", f"no replan has a finite ratio; {over}")
    else:
        ratio = Box(
            f"ratio {name}", format_number(row["geometric_mean"]), f"{_interval(row, 'geometric_mean')}; {over}"
        )
    uniform = format_number(row["uniform_ratio"])
    lift = f"{_interval(row, 'ratio_lift')}; ratio / uniform ratio"
    return [
        ratio,
        Box("with uniform attention", uniform, "what the keys that queries see alone give"),
        Box("lift", format_number(row["ratio_lift"]), lift),
    ]


def _interval(row: Mapping[str, Any], column: str) -> str:
    low, high = row[f"{column}_low"], row[f"{column}_high"]
    if low is None:
        return "no interval"
    return f"{interval_name(DEFAULT_LEVEL)} {format_interval(low, high)}"


def _fraction_boxes(analysis: Analysis) -> list[Box]:
    boxes = []
    for group in analysis.present_groups[:_MOST_FRACTIONS]:
        row = analysis.overall_groups[group]
        bounds = format_percent_interval(row["fraction_low"], row["fraction_high"])
        note = "no interval" if bounds == "-" else f"{interval_name(DEFAULT_LEVEL)} {bounds}"
        boxes.append(Box(f"fraction of {group}", format_percent(row["fraction"]), note))
    return boxes
