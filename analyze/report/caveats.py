"""What a reader of this very store's numbers has to know: read off the store and the tables, one sentence or two each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from vla_attention.analyze.measures.aggregate import overall_layer, overall_rows
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.summary import FEW_EPISODES
from vla_attention.analyze.ratios.verdict import LINGUISTIC_BELOW, VISUAL_ABOVE, verdict
from vla_attention.analyze.show.numbers import format_number, plural
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.layout import Role
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, mass_error_bound

#: Less than this share of attention is not worth a sentence.
_WORTH_SAYING = 0.005


@dataclass(frozen=True)
class Caveat:
    """One thing to know. `grave`: the numbers must not be used without it."""

    topic: str
    sentence: str
    grave: bool = False


def role_shares(question: Question) -> dict[str, float]:
    """Mean mass of the keys of each role: over replans, selected layers, denoise steps, heads and queries, then over episodes.

    From the stored segment masses, which are as they were before storage rounded the rows. Sums to the mean row sum (1).
    """
    selection = question.selection
    totals: dict[str, list[float]] = {}
    for item in question.selected:
        atoms = item.episode.read(f"{question.site}/atoms")
        atoms = atoms[:, list(selection.layers)][:, :, list(selection.denoise)][:, :, :, list(selection.heads)]
        masses = atoms.reshape(-1, atoms.shape[-1]).mean(axis=0, dtype=np.float64)
        of_role: dict[str, float] = {}
        for segment, mass in zip(item.episode.attributes.segments[question.site], masses, strict=True):
            of_role[segment.role] = of_role.get(segment.role, 0.0) + float(mass)
        for role, mass in of_role.items():
            totals.setdefault(role, []).append(mass)
    return {role: sum(masses) / len(question.selected) for role, masses in totals.items()}


def caveats(analysis: Analysis, shares: Mapping[str, float], sinks: pl.DataFrame | None = None) -> list[Caveat]:
    """Everything that applies to this analysis, the grave things first.

    `shares`: of `role_shares`; `sinks`: of `metrics.sinks.merged_sinks`, None when they were not looked for.
    """
    found = [
        *_weights(analysis.question),
        *_baseline(analysis),
        *_infinite(analysis),
        *_episodes(analysis),
        *_sites(analysis.question),
        *_keys(shares),
        *_sinks(sinks),
        *_averages(analysis.question),
        *_precision(analysis.question),
        *(Caveat("Left out", line, True) for line in analysis.question.skipped),
    ]
    return sorted(found, key=lambda caveat: not caveat.grave)


def verdict_sentence(grouping: Grouping, ratio: float | None, uniform: float | None) -> str:
    """The published guide's word for a ratio, always beside its word for uniform attention; empty where the guide does not apply."""
    if not grouping.compares_modalities or ratio is None or uniform is None:
        return ""
    word, of_uniform = verdict(ratio), verdict(uniform)
    guide = f"The published guide (above {VISUAL_ABOVE} visual, below {LINGUISTIC_BELOW} linguistic) calls "
    guide += f"{format_number(ratio)} '{word}'"
    if word == of_uniform:
        given = f"the {format_number(uniform)} that uniform attention gives"
        return f"{guide}, and {given} just the same: the word says nothing here."
    return f"{guide}, and the {format_number(uniform)} that uniform attention gives '{of_uniform}'."


def _weights(question: Question) -> list[Caveat]:
    if not question.stores[0].attributes.policy.untrained:
        return []
    return [
        Caveat(
            "Untrained weights",
            "The policy's weights are random. These numbers show that the pipeline works; they say nothing about any "
            "policy.",
            True,
        )
    ]


def _baseline(analysis: Analysis) -> list[Caveat]:
    if analysis.grouping.ratio is None:
        return [
            Caveat(
                "No ratio", f"The grouping '{analysis.grouping.name}' defines no ratio here; read fractions and lifts."
            )
        ]
    level = overall_rows(analysis.tasks)
    layer = overall_layer(level.cells)
    row, of_group = level.cells.filter(layer=layer).row(0, named=True), level.by_group("layer")
    if row["uniform_ratio"] is None:
        return [
            Caveat(
                "No baseline",
                "A side of the ratio has no keys, so uniform attention has no ratio to compare with.",
                True,
            )
        ]
    above, below = (
        sum(of_group[layer, name]["keys"] for name in side)
        for side in (analysis.grouping.ratio.numerator, analysis.grouping.ratio.denominator)
    )
    return [
        Caveat(
            "Uniform baseline",
            f"There are on average {format_number(above)} keys above the line and {format_number(below)} below it, so "
            f"attention that treats "
            f"all keys alike has the ratio {format_number(row['uniform_ratio'])}. Read the lift: 1 is what uniform "
            f"attention gives.",
        )
    ]


def _infinite(analysis: Analysis) -> list[Caveat]:
    if analysis.grouping.ratio is None:
        return []
    rows = overall_rows(analysis.tasks).cells
    row = rows.filter(layer=overall_layer(rows)).row(0, named=True)
    left_out = row["num_nonfinite"] or 0
    layers = row["nonfinite_layers"] or 0
    if not left_out and not layers:
        return []
    sentence = (
        f"{left_out} of {row['num_replans']} replans have an infinite or undefined ratio (no mass below the line) and "
        f"are in no mean, "
        f"median or geometric mean; the ratio of means and the fractions include them."
    )
    if layers > left_out:
        sentence += f" {layers} ratios of single layers are left out of the average over layers."
    return [Caveat("Infinite ratios", sentence, True)]


def _episodes(analysis: Analysis) -> list[Caveat]:
    rows = analysis.tasks.cells.filter(layer=overall_layer(analysis.tasks.cells))
    tasks = rows.filter(scope="task")
    counts = tasks["num_episodes"].to_list()
    if sum(counts) == 1:
        return [
            Caveat(
                "One episode",
                "A single episode says nothing about how much episodes differ: there are no intervals.",
                True,
            )
        ]
    found = []
    if min(counts) < FEW_EPISODES:
        found.append(
            Caveat(
                "Few episodes",
                f"Tasks have {_from_to(counts)} each. Intervals are widened for small numbers, "
                f"and still say little with fewer "
                f"than {FEW_EPISODES} episodes of a task.",
            )
        )
    if len(counts) == 1:
        found.append(Caveat("One task", "The intervals speak of more episodes of this task, not of other tasks."))
    return found


def _from_to(counts: list[int]) -> str:
    low, high = min(counts), max(counts)
    return plural(high, "episode") if low == high else f"{low} to {high} episodes"


def _sites(question: Question) -> list[Caveat]:
    others = [site.name for site in question.stores[0].attributes.sites if site.name != question.site]
    if not others:
        return []
    return [
        Caveat(
            "Sites",
            f"Everything here is of the site '{question.site}'. The other sites ({listing(others)}) are softmaxes of "
            f"their own: each row sums to 1 by "
            "itself, and a mass of one must not be divided by a mass of another. Norms of contributions may.",
            True,
        )
    ]


def _keys(shares: Mapping[str, float]) -> list[Caveat]:
    found = []
    padding = sum(shares.get(role.label, 0.0) for role in (Role.PADDING, Role.NULL))
    if padding >= _WORTH_SAYING:
        found.append(
            Caveat(
                "Padding",
                f"Positions without a word take {100 * padding:.1f} % of the attention. They add nothing, count as no "
                f"valid key, and are in no side of the "
                "ratio, but in the sum that fractions are shares of.",
            )
        )
    elif Role.PADDING.label in shares:
        found.append(Caveat("Padding", "Padding is masked out and takes no attention; it counts in no baseline."))
    if shares.get(Role.MASKED_IMAGE.label, 0.0) >= _WORTH_SAYING:
        found.append(
            Caveat(
                "Masked cameras",
                f"Cameras that show nothing take {100 * shares[Role.MASKED_IMAGE.label]:.1f} % of the attention.",
                True,
            )
        )
    bos = shares.get(Role.BOS.label, 0.0)
    if bos >= _WORTH_SAYING:
        found.append(
            Caveat(
                "Beginning of sequence",
                f"The first text key, which is no word, takes {100 * bos:.1f} % of the attention and counts as "
                f"linguistic in the default grouping; "
                "--grouping instruction leaves it out.",
            )
        )
    return found


def _sinks(sinks: pl.DataFrame | None) -> list[Caveat]:
    if sinks is None:
        return [
            Caveat(
                "Sinks", "Keys that take far more than their share were not looked for; vla-analyze heads lists them."
            )
        ]
    if sinks.is_empty():
        return []
    names = listing(sinks["description"].to_list(), 3)
    share = 100 * float(sinks["mean_mass"].sum())
    return [
        Caveat(
            "Sinks",
            f"{sinks.height} key{'s take' if sinks.height > 1 else ' takes'} far more than the share of a key in most "
            f"rows ({names}), together "
            f"{share:.0f} % of the attention to valid keys in the tasks that have them. They may mean nothing, and "
            f"they move the ratio: compare with --without-sinks.",
            True,
        )
    ]


def _averages(question: Question) -> list[Caveat]:
    root, selection = question.stores[0].attributes, question.selection
    recording = root.recording
    found = []
    if recording.queries == "mean" and recording.num_action_queries > 1:
        found.append(
            Caveat(
                "Mean over queries",
                f"Rows are means over the {recording.num_action_queries} action queries, taken when they were "
                f"recorded: that the first and the last step "
                "of an action chunk look elsewhere cannot be seen here.",
            )
        )
    blocks = len(set(selection.blocks))
    if blocks < root.policy.num_layers or len(selection.heads) < root.policy.num_heads:
        found.append(
            Caveat(
                "Part of the model",
                f"{blocks} of {root.policy.num_layers} layers and {len(selection.heads)} of {root.policy.num_heads} "
                f"heads are looked at.",
            )
        )
    if len(selection.denoise) < root.policy.num_denoise_steps:
        found.append(
            Caveat(
                "Denoise steps",
                f"Means over denoise step{'s' if len(selection.denoise) > 1 else ''} "
                f"{listing(selection.denoise_steps)} of {root.policy.num_denoise_steps}.",
            )
        )
    if selection.note:
        found.append(Caveat("Layer numbers", selection.note))
    return found


def _precision(question: Question) -> list[Caveat]:
    root = question.stores[0].attributes
    dtype = root.policy.config.get("dtype")
    found = []
    if dtype == "bfloat16":
        found.append(
            Caveat(
                "bfloat16",
                "The model computed in bfloat16: queries and keys were rounded to 8 bits before their product was "
                "taken, so a probability is known to "
                "some per cent. Rows were recorded in float32 after the softmax and sum to 1.",
            )
        )
    elif dtype is None:
        found.append(Caveat("Compute type", "The store does not say in which number type the model computed."))
    else:
        found.append(Caveat("Compute type", f"The model computed in {dtype}; rows were recorded in float32."))
    bits = recording_bits = root.recording.mantissa_bits
    if bits < FLOAT32_MANTISSA_BITS:
        bound = mass_error_bound(bits)
        found.append(
            Caveat(
                "Rounding",
                f"Stored rows keep {recording_bits} mantissa bits: every mass of every grouping is within "
                f"{100 * bound:.2g} % of what the model computed, "
                f"every ratio within {200 * bound:.2g} %.",
            )
        )
    return found
