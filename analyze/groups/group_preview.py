"""What a grouping takes, without reading rows: keys by span and role, words with their pieces, overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.masses import uniform_ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
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


@dataclass(frozen=True)
class GroupPreview:
    """What the groups of a grouping are on the selected episodes.

    Attributes:
        groups: one row per (group, span, role) with keys in at least one replan; columns `keys_min`, `keys_mean`,
            `keys_max` over all replans of all episodes (a replan without such keys counts as 0), `kind` of the span,
            `span_keys`. Rows whose span and role are null are a group's totals. What no group takes is listed as `(no
            group)`.
        words: one row per (group, word, pieces): `pieces` is the word's tokens joined by `+`, `num_pieces` how many of
            them there are, `episodes` in how many episodes the group takes at least one of them.
        overlaps: one row per pair of groups that share keys, with `keys_min`, `keys_mean`, `keys_max`; empty for
            disjoint groups.
        uniform_ratio: (lowest, highest) ratio that uniform attention gives over all replans and selected layers, None
            without a ratio.
    """

    groups: pl.DataFrame
    words: pl.DataFrame
    overlaps: pl.DataFrame
    uniform_ratio: tuple[float, float] | None


def preview_groups(question: Question) -> GroupPreview:
    """Resolve the grouping on every selected episode. Reads roles and object coverage, no rows.

    Raises:
        UserError: a subclass that says what is wrong with the grouping; see `measures.selected.resolve_all`.
    """
    grouping = question.grouping
    resolve_all(grouping, question.selected, question.vocabulary)  # all checks, with the user's own groups
    whole = _with_untaken(grouping)
    resolved = [resolve(whole, item.tokens) for item in question.selected]
    names = [UNTAKEN if name == _UNTAKEN_GROUP else name for name in whole.names]
    return GroupPreview(
        groups=_groups_table(question, names, resolved),
        words=_words_table(question, names, resolved),
        overlaps=_overlaps_table(question),
        uniform_ratio=_uniform_ratio(question, resolved),
    )


def pieces_of(word: Word, prompt: Prompt) -> tuple[str, ...]:
    """The text of a word's tokens, without the space before them."""
    texts = {piece.key: visible(prompt.text[piece.start : piece.stop].strip()) for piece in prompt.pieces}
    return tuple(texts[key] for key in word.keys)


def _with_untaken(grouping: Grouping) -> Grouping:
    """The grouping with one more group, of the keys that no group takes; unless a group takes the rest already."""
    if any(selectors[0].strip() == REST for selectors in grouping.groups.values()):
        return grouping
    return replace(grouping, groups={**grouping.groups, _UNTAKEN_GROUP: (REST,)})


def _groups_table(question: Question, names: Sequence[str], resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame:
    layout = question.selected[0].tokens.layout
    segments = merge_segments(layout, (segments_of(layout, item.tokens.static_roles) for item in question.selected))
    counts = []
    for item, groups in zip(question.selected, resolved, strict=True):
        members = segment_members(layout, item.tokens.static_roles, segments).astype(np.float32)
        keys = np.matmul(groups.weights.transpose(0, 2, 1), members)  # (replan or 1, group, segment)
        # A number that is the same at all replans of an episode counts once per replan.
        counts.append(np.broadcast_to(keys, (item.tokens.num_replans, *keys.shape[1:])))
    every = np.concatenate(counts).astype(np.float64)
    rows = []
    for i, name in enumerate(names):
        if name == UNTAKEN and every[:, i].max(initial=0.0) < _NEGLIGIBLE:
            continue
        rows.append(_counts_row(name, None, None, None, None, every[:, i].sum(axis=1)))
        for j, segment in enumerate(segments):
            if every[:, i, j].max(initial=0.0) >= _NEGLIGIBLE:
                span = layout.span(segment.span)
                rows.append(_counts_row(name, span.name, span.kind, segment.role, span.num_keys, every[:, i, j]))
    return pl.DataFrame(rows, schema=_GROUP_SCHEMA, orient="row")


_COUNTS: dict[str, type[pl.DataType]] = {"keys_min": pl.Float64, "keys_mean": pl.Float64, "keys_max": pl.Float64}
_GROUP_SCHEMA: dict[str, type[pl.DataType]] = {
    "group": pl.String, "span": pl.String, "kind": pl.String, "role": pl.String, "span_keys": pl.Int64, **_COUNTS,
}  # fmt: skip
_WORD_SCHEMA: dict[str, type[pl.DataType]] = {
    "group": pl.String, "word": pl.String, "pieces": pl.String, "num_pieces": pl.Int64, "episodes": pl.Int64,
}  # fmt: skip
_OVERLAP_SCHEMA: dict[str, type[pl.DataType]] = {"group": pl.String, "other": pl.String, **_COUNTS}


def _counts_row(
    name: str, span: str | None, kind: str | None, role: str | None, span_keys: int | None, keys: NDArray[np.float64]
) -> tuple[str, str | None, str | None, str | None, int | None, float, float, float]:
    return (name, span, kind, role, span_keys, float(keys.min()), float(keys.mean()), float(keys.max()))


def _words_table(question: Question, names: Sequence[str], resolved: Sequence[ResolvedGrouping]) -> pl.DataFrame:
    episodes: dict[tuple[str, str, str, int], int] = {}
    for item, groups in zip(question.selected, resolved, strict=True):
        tokens = item.tokens
        instances: set[tuple[str, str, str, int]] = set()
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
                    instances.add((names[int(i)], word.text.casefold(), "+".join(pieces).casefold(), len(pieces)))
        for key in instances:
            episodes[key] = episodes.get(key, 0) + 1
    order = {name: i for i, name in enumerate(names)}
    rows = sorted(((*key, count) for key, count in episodes.items()), key=lambda row: (order[row[0]], -row[4], row[1]))
    return pl.DataFrame(rows, schema=_WORD_SCHEMA, orient="row")


def _overlaps_table(question: Question) -> pl.DataFrame:
    if not question.grouping.overlap:
        return pl.DataFrame(schema=_OVERLAP_SCHEMA)
    counts = []
    for item in question.selected:
        shared = shared_keys(question.grouping, item.tokens)
        counts.append(np.broadcast_to(shared, (item.tokens.num_replans, *shared.shape[1:])))
    every = np.concatenate(counts)
    names = question.grouping.names
    rows = [
        (names[i], names[j], keys.min(), keys.mean(), keys.max())
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if (keys := every[:, i, j]).max(initial=0.0) >= _NEGLIGIBLE
    ]
    return pl.DataFrame(rows, schema=_OVERLAP_SCHEMA, orient="row")


def _uniform_ratio(question: Question, resolved: Sequence[ResolvedGrouping]) -> tuple[float, float] | None:
    grouping = question.grouping
    if grouping.ratio is None:
        return None
    values = np.concatenate(
        [
            uniform_ratio(uniform_masses(uniform_keys(item, question.selection), one.weights), grouping).ravel()
            for item, one in zip(question.selected, resolved, strict=True)
        ]
    )
    defined = values[~np.isnan(values)]
    return (float(defined.min()), float(defined.max())) if defined.size else None
