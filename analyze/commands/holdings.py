"""`analyze --list`: what stores hold, and what a grouping takes of it. Reads roles and object coverage, no rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.about import about
from vla_attention.analyze.core.result import Column, Finding, Result, Table
from vla_attention.analyze.measures.masses import uniform_keys, uniform_masses, uniform_ratio
from vla_attention.analyze.measures.question import Question, baseline_notes
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.stores.contents import lines_of_store
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.grouping import REST, Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping, resolve, shared_keys
from vla_attention.schemas.groupings.words import Word
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.segments import merge_segments, segment_members, segments_of

#: Name under which tables list what no group takes.
UNTAKEN = "(no group)"
_UNTAKEN_GROUP = "_no_group"
#: A smaller part of a key comes from rounded areas, and is not listed.
_NEGLIGIBLE = 1e-4
_COUNTS = {"keys_min": pl.Float64, "keys_mean": pl.Float64, "keys_max": pl.Float64}
_GROUPS = {
    "group": pl.String,
    "span": pl.String,
    "kind": pl.String,
    "role": pl.String,
    "span_keys": pl.Int64,
    **_COUNTS,
}
_WORDS = {"group": pl.String, "word": pl.String, "pieces": pl.String, "num_pieces": pl.Int64, "episodes": pl.Int64}
_OVERLAPS = {"group": pl.String, "other": pl.String, **_COUNTS}
_OF_KEYS = (Column("keys_min", "number", "fewest", "tokens at a policy call; an object counts the area that it covers, "
                   "in patches"), Column("keys_max", "number", "most"))  # fmt: skip


def holdings(question: Question) -> Result:
    """What the stores hold (table "stores"), and what every group takes of it.

    Tables: "groups" has a row per (group, span, role) with keys at a replan, over all replans of all episodes (one
    without such keys counts as 0); rows without a span are a group's totals, and what no group takes is listed as `(no
    group)`. "group_words" has a row per (group, word, pieces) and in how many episodes the group takes it,
    "group_overlaps" one per pair of groups that share keys.

    Raises:
        UserError: a subclass that says what is wrong with the grouping; see `measures.selected.resolve_all`.
    """
    grouping = question.grouping
    resolve_all(grouping, question.selected, question.vocabulary)  # all checks, with the user's own groups
    whole = _with_untaken(grouping)
    resolved = [resolve(whole, item.tokens) for item in question.selected]
    names = [UNTAKEN if name == _UNTAKEN_GROUP else name for name in whole.names]
    groups, words = _groups(question, names, resolved), _words(question, names, resolved)
    overlaps = overlaps_of(question)
    selectors = pl.DataFrame(
        [(name, " | ".join(parts)) for name, parts in grouping.groups.items()],
        schema={"group": pl.String, "selector": pl.String}, orient="row",
    )  # fmt: skip
    groups = groups.join(selectors, on="group", how="left", maintain_order="left")
    held = [(name, text) for store in question.stores for name, text in lines_of_store(store, question.settings.tasks)]
    stores = pl.DataFrame(held, schema={"what": pl.String, "held": pl.String}, orient="row")
    total = pl.col("span").is_null()
    return Result(
        "What the stores hold",
        about(question),
        [_finding(question, groups, overlaps)],
        [
            Table("stores", stores, (Column("what", "text", "of the store"), Column("held", "prose", "")), rows=1000),
            Table("groups", groups, (Column("group", "text"), *_OF_KEYS, Column("selector", "prose")), "Groups", total,
                  200),
            Table("parts", groups, (Column("group", "text"), Column("span", "text"), Column("role", "text"), *_OF_KEYS,
                  Column("span_keys", "count", "of the span's")), "Of which", ~total, 200, of="groups"),
            Table("group_words", words, (Column("group", "text"), Column("word", "text"), Column("pieces", "text"),
                  Column("episodes", "count")), "Words", rows=200),
            Table("group_overlaps", overlaps, (Column("group", "text"), Column("other", "text"), *_OF_KEYS), "Shared"),
        ],
        notes=[*question.skipped, *_uniform(question, resolved)],
        whole=True,
    )  # fmt: skip


def _finding(question: Question, groups: pl.DataFrame, overlaps: pl.DataFrame) -> Finding:
    grouping = question.grouping
    said = f"Grouping '{grouping.name}' has {plural(len(grouping.names), 'group')} of site '{question.site}'"
    said += f", {plural(overlaps.height, 'pair')} of which share tokens" if overlaps.height else ""
    left = groups.filter(pl.col("span").is_null(), group=UNTAKEN)
    if left.is_empty():
        return Finding(f"{said}; every token is in a group.", "What does the grouping take?")
    rest = groups.filter(pl.col("span").is_not_null(), group=UNTAKEN)
    named = listing([f"{row['role']} of {row['span']}" for row in rest.iter_rows(named=True)])
    limit = f"No group takes {named}: their attention is in no fraction; add a group '*' to have it."
    return Finding(f"{said}; {left['keys_max'][0]:.3g} tokens are in none.", "What does the grouping take?", {}, limit)


def pieces_of(word: Word, prompt: Prompt) -> tuple[str, ...]:
    """The text of a word's tokens, without the space before them."""
    texts = {piece.key: visible(prompt.text[piece.start : piece.stop].strip()) for piece in prompt.pieces}
    return tuple(texts[key] for key in word.keys)


def _with_untaken(grouping: Grouping) -> Grouping:
    """The grouping with one more group, of the keys that no group takes; unless a group takes the rest already."""
    if any(selectors[0].strip() == REST for selectors in grouping.groups.values()):
        return grouping
    return replace(grouping, groups={**grouping.groups, _UNTAKEN_GROUP: (REST,)})


def _groups(question: Question, names: Sequence[str], resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame:
    layout = question.selected[0].tokens.layout
    segments = merge_segments(layout, (segments_of(layout, item.tokens.static_roles) for item in question.selected))
    counts = []
    for item, groups in zip(question.selected, resolved, strict=True):
        members = segment_members(layout, item.tokens.static_roles, segments).astype(np.float32)
        keys = np.matmul(groups.weights.transpose(0, 2, 1), members)  # (replan or 1, group, segment)
        # A number that is the same at all replans of an episode counts once per replan.
        counts.append(np.broadcast_to(keys, (item.tokens.num_replans, *keys.shape[1:])))
    every = np.concatenate(counts).astype(np.float64)
    rows: list[tuple[object, ...]] = []
    for i, name in enumerate(names):
        if name == UNTAKEN and every[:, i].max(initial=0.0) < _NEGLIGIBLE:
            continue
        rows.append((name, None, None, None, None, *_spread(every[:, i].sum(axis=1))))
        for j, segment in enumerate(segments):
            if every[:, i, j].max(initial=0.0) >= _NEGLIGIBLE:
                span = layout.span(segment.span)
                rows.append((name, span.name, span.kind, segment.role, span.num_keys, *_spread(every[:, i, j])))
    return pl.DataFrame(rows, schema=_GROUPS, orient="row")


def _spread(keys: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(keys.min()), float(keys.mean()), float(keys.max())


def _words(question: Question, names: Sequence[str], resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame:
    episodes: Counter[tuple[str, str, str, int]] = Counter()
    for item, groups in zip(question.selected, resolved, strict=True):
        tokens, taken = item.tokens, set()
        if not tokens.words or tokens.prompt_index is None:
            continue
        for which, (prompt, words) in enumerate(zip(tokens.prompts, tokens.words, strict=True)):
            replans = np.flatnonzero(tokens.prompt_index == which)
            if not len(replans):
                continue
            weights = groups.weights[replans if len(groups.weights) > 1 else [0]].max(axis=0)  # (key, group)
            for word in words:
                pieces = pieces_of(word, prompt)
                for i in np.flatnonzero(weights[list(word.keys)].max(axis=0, initial=0) > 0):
                    taken.add((names[int(i)], word.text.casefold(), "+".join(pieces).casefold(), len(pieces)))
        episodes.update(taken)
    order = {name: i for i, name in enumerate(names)}
    rows = sorted(((*key, count) for key, count in episodes.items()), key=lambda row: (order[row[0]], -row[4], row[1]))
    return pl.DataFrame(rows, schema=_WORDS, orient="row")


def overlaps_of(question: Question) -> pl.DataFrame:
    """Pairs of groups that share keys, and how many at a policy call."""
    if not question.grouping.overlap:
        return pl.DataFrame(schema=_OVERLAPS)
    counts = []
    for item in question.selected:
        shared = shared_keys(question.grouping, item.tokens)
        counts.append(np.broadcast_to(shared, (item.tokens.num_replans, *shared.shape[1:])))
    every, names = np.concatenate(counts), question.grouping.names
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    rows = [
        (names[i], names[j], *_spread(every[:, i, j]))
        for i, j in pairs
        if every[:, i, j].max(initial=0.0) >= _NEGLIGIBLE
    ]
    return pl.DataFrame(rows, schema=_OVERLAPS, orient="row")


def _uniform(question: Question, resolved: Sequence[ResolvedGrouping]) -> list[str]:
    """What attention that is spread evenly gives the grouping's ratio, over all replans and selected layers."""
    grouping = question.grouping
    if grouping.ratio is None:
        return []
    values = np.concatenate(
        [
            uniform_ratio(uniform_masses(uniform_keys(item, question.selection), one.weights), grouping).ravel()
            for item, one in zip(question.selected, resolved, strict=True)
        ]
    )
    defined = values[~np.isnan(values)]
    if not defined.size:
        return []
    low, high = (f"{end:.4g}" for end in (defined.min(), defined.max()))
    bounds = low if low == high else f"{low} to {high}"
    side = " / ".join(" + ".join(part) for part in (grouping.ratio.numerator, grouping.ratio.denominator))
    return [
        f"Attention spread evenly over all tokens gives the ratio {side} {bounds}.",
        *baseline_notes(question.stores),
    ]
