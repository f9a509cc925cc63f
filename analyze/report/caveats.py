"""Caveats: what a reader of exactly these numbers has to know. Each is read off the store or the tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import polars as pl

from vla_attention.analyze.measures.baselines import baseline_notes, contribution_notes
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.sink_kinds import may_be_empty
from vla_attention.analyze.measures.sinks import SinkRule, merged_sinks, sinks_of_sides
from vla_attention.analyze.measures.task_families import family_notes, unknown_families
from vla_attention.analyze.ratios.analysis import Analysis, site_without_a_side
from vla_attention.analyze.ratios.summary_text import FEW_EPISODES
from vla_attention.analyze.report.section_parts import Section
from vla_attention.analyze.show.headings import untrained_sentence
from vla_attention.analyze.show.numbers import format_number, format_percent, plural
from vla_attention.analyze.stores.run_notes import run_notes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.layout import Role
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, mass_error_bound
from vla_attention.schemas.stores.store_format import CALLERS_MODULES

#: A smaller share of attention is not mentioned.
_WORTH_MENTIONING = 0.005


@dataclass(frozen=True)
class Caveat:
    """One thing to know. `grave`: the numbers must not be used without it."""

    topic: str
    sentence: str
    grave: bool = False


@dataclass(frozen=True)
class Caveats:
    """A list of caveats."""

    template: ClassVar[str] = "caveats.html"
    caveats: Sequence[Caveat]


def caveat_section(caveats: Sequence[Caveat]) -> Section:
    """All caveats of this report."""
    return Section("caveats", "What to know about these numbers", [Caveats(caveats)])


def caveats(analysis: Analysis, masses: Mapping[str, float], sinks: pl.DataFrame | None = None) -> list[Caveat]:
    """All caveats that apply to this analysis, the grave ones first.

    Args:
        analysis: the tables.
        masses: of `role_masses`.
        sinks: `SinkSearch.sinks`; None when nobody looked for sinks.
    """
    question = analysis.question
    given = [
        *_weights(question),
        *_dependence(question),
        *_baseline(analysis),
        *_infinite(analysis),
        *_episodes(analysis),
        *_sites(question),
        *_padding(masses),
        *_cameras(masses),
        *_beginning(masses),
        *_sinks(question, sinks),
        *_queries(question),
        *_parts_of_the_model(question),
        *_compute_type(question),
        *_rounding(question),
        *(Caveat("Left out", line, True) for line in question.skipped),
        *(Caveat("Changed or cut", line, True) for line in run_notes(question.episodes)),
        *(Caveat("Baseline of version 1", line, True) for line in baseline_notes(question.stores)),
        *(Caveat("Contributions of version 1", line, True) for line in contribution_notes(question.stores)),
        *_related_tasks(question),
        *(Caveat("Chosen part", line) for line in question.notes),
    ]
    return sorted(given, key=lambda caveat: not caveat.grave)


def _related_tasks(question: Question) -> list[Caveat]:
    warning = unknown_families(question.sampling, question.selected)
    notes = family_notes(question.sampling, question.selected)
    return [Caveat("Related tasks", line, True) for line in (*([warning] if warning else []), *notes)]


def _weights(question: Question) -> list[Caveat]:
    if not question.untrained:
        return []
    return [Caveat("Untrained weights", untrained_sentence("The policy has"), True)]


def _dependence(question: Question) -> list[Caveat]:
    if question.untrained:
        return []
    recorded = any(store.attributes.protocol.name == "recorded" for store in question.stores)
    how = "vla-attention capture rerun with --prompt, or with --knockout and --knockout-queries all"
    if any(store.attributes.policy.checkpoint_format == CALLERS_MODULES for store in question.stores):
        how = (
            "vla-attention capture replay with another --instruction, or with --knockout and --rerun-of "
            "(docs/data-sets.md)"
        )
    if recorded:
        how = "va.record with another instruction, or with knockout=... (docs/your-policy.md)"
    sentence = (
        "Attention says which keys the action queries read, not on what the action depends: in policies that were "
        "trained to need one word of the sentence, this word got less attention than a key's uniform share, because "
        "the keys of the pictures had read it (docs/validation.md). A dependence is shown by an intervention: "
        f"{how}."
    )
    return [Caveat("Attention and dependence", sentence)]


def _baseline(analysis: Analysis) -> list[Caveat]:
    grouping, uniform = analysis.grouping, analysis.overall.get("uniform_ratio")
    if grouping.ratio is None:
        sentence = f"The grouping '{grouping.name}' defines no ratio here; read fractions and lifts."
        if one_sided := site_without_a_side(analysis.question.stores[0].attributes, analysis.question.site):
            sentence += f" {one_sided}"
        return [Caveat("No ratio", sentence)]
    if uniform is None:
        sentence = "A side of the ratio has no keys, so uniform attention has no ratio to compare with."
        return [Caveat("No baseline", sentence, True)]
    above, below = (
        format_number(sum(analysis.overall_groups[name]["keys"] for name in side))
        for side in (grouping.ratio.numerator, grouping.ratio.denominator)
    )
    sentence = (
        f"The numerator has {above} keys on average and the denominator {below}; attention that is uniform at each "
        f"query has the ratio {format_number(uniform)}. Read the lift: 1 is what uniform attention gives."
    )
    return [Caveat("Uniform baseline", sentence)]


def _infinite(analysis: Analysis) -> list[Caveat]:
    row = analysis.overall
    left_out, layers = row.get("num_nonfinite") or 0, row.get("nonfinite_layers") or 0
    if not left_out and not layers:
        return []
    sentence = (
        f"{left_out} of {row['num_replans']} replans have an infinite or undefined ratio (no mass in the denominator) "
        "and are in no mean, median or geometric mean; the ratio of means and the fractions include them."
    )
    if layers > left_out:
        sentence += f" {layers} ratios of single layers are left out of the average over layers."
    return [Caveat("Infinite ratios", sentence, True)]


def _episodes(analysis: Analysis) -> list[Caveat]:
    tasks = analysis.tasks.cells.filter(layer=analysis.overall["layer"], scope="task")
    counts = tasks["num_episodes"].to_list()
    if sum(counts) == 1:
        sentence = "A single episode does not show how much episodes differ: there are no intervals."
        return [Caveat("One episode", sentence, True)]
    given = []
    if min(counts) < FEW_EPISODES:
        low, high = min(counts), max(counts)
        several = plural(high, "episode") if low == high else f"{low} to {high} episodes"
        sentence = (
            f"Tasks have {several} each: the interval of a task with fewer than {FEW_EPISODES} episodes is wide, and "
            "relies on ratios that are normal on a logarithmic scale."
        )
        given.append(Caveat("Few episodes", sentence))
    if len(counts) == 1:
        given.append(Caveat("One task", "The intervals are about more episodes of this task, not about other tasks."))
    return given


def _sites(question: Question) -> list[Caveat]:
    others = [site.name for site in question.stores[0].attributes.sites if site.name != question.site]
    if not others:
        return []
    sentence = (
        f"Everything here is of the site '{question.site}'. The other sites ({listing(others)}) are separate "
        "softmaxes: each row sums to 1, and a mass of one site must not be divided by a mass of another. Norms of "
        "contributions may."
    )
    return [Caveat("Sites", sentence, True)]


def _padding(masses: Mapping[str, float]) -> list[Caveat]:
    padding = sum(masses.get(role.label, 0.0) for role in (Role.PADDING, Role.NULL))
    if padding >= _WORTH_MENTIONING:
        sentence = (
            f"Positions without a word take {format_percent(padding)} of the attention. They add nothing and are no "
            "valid keys. They are on no side of the ratio, but in the total of the fractions."
        )
        return [Caveat("Padding", sentence)]
    if Role.PADDING.label in masses:
        return [Caveat("Padding", "Padding is masked out and takes no attention; it is in no baseline.")]
    return []


def _cameras(masses: Mapping[str, float]) -> list[Caveat]:
    masked = masses.get(Role.MASKED_IMAGE.label, 0.0)
    if masked < _WORTH_MENTIONING:
        return []
    sentence = f"Cameras without a picture take {format_percent(masked)} of the attention."
    return [Caveat("Masked cameras", sentence, True)]


def _beginning(masses: Mapping[str, float]) -> list[Caveat]:
    share = masses.get(Role.BOS.label, 0.0)
    if share < _WORTH_MENTIONING:
        return []
    sentence = (
        f"The first text key, which is no word, takes {format_percent(share)} of the attention and counts as "
        "linguistic in the default grouping; --grouping instruction leaves it out."
    )
    return [Caveat("Beginning of sequence", sentence)]


def _sinks(question: Question, sinks: pl.DataFrame | None) -> list[Caveat]:
    if sinks is None:
        sentence = (
            "This report did not look for keys that take far more than their share; vla-attention heads lists them."
        )
        return [Caveat("Sinks", sentence)]
    sinks = merged_sinks(sinks_of_sides(question, sinks.filter("widespread")))
    if sinks.is_empty():
        return []
    share = format_percent(float(sinks["mean_mass"].sum()), 0)
    sentence = (
        f"{plural(sinks.height, 'key')} {'take' if sinks.height > 1 else 'takes'} far more than the share of a key in "
        f"{SinkRule().heads:.0%} or more of the layers' heads ({listing(sinks['description'].to_list(), 3)}), "
        f"together {share} of the attention to valid keys in the tasks that have them. "
        f"{_what_sinks_hold(sinks)} They change the {'fractions' if question.grouping.ratio is None else 'ratio'}: "
        "compare with --without-sinks."
    )
    return [Caveat("Sinks", sentence, True)]


def _what_sinks_hold(sinks: pl.DataFrame) -> str:
    """Sentences on merged sinks: which may be empty, which are read, and of which nothing recorded tells."""
    kinds: dict[str, list[str]] = {"empty": [], "read": [], "unknown": []}
    for role, description, values in sinks.select("role", "description", "value_ratio").iter_rows():
        kind = "empty" if may_be_empty(role, values) else "unknown" if values is None else "read"
        kinds[kind].append(description)
    said = {
        "empty": "may carry no information",
        "read": "do carry information, as much for their mass as other keys",
        "unknown": "have words, pixels or state as content, which these heads may look for",
    }
    parts = [
        f"{'they' if len(names) == sinks.height else f'some ({listing(names, 3)})'} {said[kind]}"
        for kind, names in kinds.items()
        if names
    ]
    text = "; ".join(parts)
    return f"{text[0].upper()}{text[1:]}."


def _queries(question: Question) -> list[Caveat]:
    recording = question.stores[0].attributes.recording_of(question.site)
    if recording.queries != "mean" or recording.num_action_queries == 1:
        return []
    sentence = (
        f"Rows are means over the {recording.num_action_queries} action queries, taken at capture: differences between "
        "the first and the last step of an action chunk are not visible here."
    )
    return [Caveat("Mean over queries", sentence)]


def _parts_of_the_model(question: Question) -> list[Caveat]:
    policy, selection = question.stores[0].attributes.policy, question.selection
    blocks, heads, steps = len(set(selection.blocks)), len(selection.heads), selection.denoise_steps
    given = []
    num_layers, num_heads = question.stores[0].attributes.size_of(question.site)
    if blocks < num_layers or heads < num_heads:
        sentence = f"These numbers are of {blocks} of {num_layers} layers and {heads} of {num_heads} heads."
        given.append(Caveat("Part of the model", sentence))
    if len(steps) < policy.num_denoise_steps and not question.notes:
        which = "step" if len(steps) == 1 else "steps"
        sentence = f"Means over denoise {which} {listing(steps)} of {policy.num_denoise_steps}."
        given.append(Caveat("Denoise steps", sentence))
    if selection.note:
        given.append(Caveat("Layer numbers", selection.note))
    return given


def _compute_type(question: Question) -> list[Caveat]:
    dtype = question.stores[0].attributes.policy.config.get("dtype")
    if dtype is None:
        return [Caveat("Compute type", "The store does not state in which number type the model computed.")]
    if dtype != "bfloat16":
        return [Caveat("Compute type", f"The model computed in {dtype}; rows were recorded in float32.")]
    sentence = (
        "The model computed in bfloat16: queries and keys were rounded to 8 bits before they were multiplied, so the "
        "error of a probability is some per cent. Rows were recorded in float32 after the softmax and sum to 1."
    )
    return [Caveat("bfloat16", sentence)]


def _rounding(question: Question) -> list[Caveat]:
    bits = question.stores[0].attributes.recording.mantissa_bits
    if bits >= FLOAT32_MANTISSA_BITS:
        return []
    bound = 100 * mass_error_bound(bits)
    sentence = (
        f"Stored rows keep {bits} mantissa bits: every mass of every grouping is within {bound:.2g}% of what the model "
        f"computed, every ratio within {2 * bound:.2g}%."
    )
    return [Caveat("Rounding", sentence)]
