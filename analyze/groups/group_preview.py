"""What a grouping takes, before any number is computed from rows: keys by span and role, words with their pieces, overlaps."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.masses import ratio
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_all
from vla_attention.analyze.show.numbers import format_number, plural
from vla_attention.analyze.show.text_table import text_table
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.groupings.grouping import REST, Grouping
from vla_attention.schemas.groupings.resolve import ResolvedGrouping, resolve, shared_keys
from vla_attention.schemas.groupings.words import Word
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.segments import merge_segments, segment_members, segments_of

#: Name under which tables list what no group takes.
UNTAKEN = "(no group)"
_UNTAKEN_GROUP = "_no_group"
WIDTH = 100
#: Less than this part of a key is rounding of covered areas, and is not listed.
_NEGLIGIBLE = 1e-4


@dataclass(frozen=True)
class GroupPreview:
    """What the groups of a grouping are on the selected episodes.

    Attributes:
        groups: one row per (group, span, role) with keys in at least one replan; columns `keys_min`, `keys_mean`, `keys_max`
            over all replans of all episodes (a replan without such keys counts as 0), `kind` of the span, `span_keys`. Rows whose
            span and role are null are a group's totals. What no group takes is listed as `(no group)`.
        words: one row per (group, word, pieces): `pieces` is the word's tokens joined by `+`, `num_pieces` how many of them there
            are, `episodes` in how many episodes the group takes at least one of them.
        overlaps: one row per pair of groups that share keys, with `keys_min`, `keys_mean`, `keys_max`; empty for disjoint groups.
        uniform_ratio: (lowest, highest) ratio that uniform attention gives over all replans, None without a ratio.
    """

    groups: pl.DataFrame
    words: pl.DataFrame
    overlaps: pl.DataFrame
    uniform_ratio: tuple[float, float] | None


def preview_groups(question: Question) -> GroupPreview:
    """Resolve the grouping on every selected episode and describe what it takes. Reads roles and object coverage, no rows.

    Raises:
        UserError: a subclass that says what is wrong with the grouping; see `vla_attention.analyze.measures.steps.resolve_all`.
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
        uniform_ratio=_uniform_ratio(grouping, resolved),
    )


def groups_table(question: Question) -> pl.DataFrame:
    """How many keys each group takes of which spans and roles; see `GroupPreview.groups`."""
    return preview_groups(question).groups


def find_example(selected: Sequence[SelectedEpisode], task: int | None, episode: int | None) -> SelectedEpisode:
    """The first selected episode of that task and number; the error lists what there is."""
    for item in selected:
        attributes = item.episode.attributes
        if task in (None, attributes.task_id) and episode in (None, attributes.episode_index):
            return item
    wanted = " ".join(
        f"{what} {number}" for what, number in (("task", task), ("episode", episode)) if number is not None
    )
    raise BadArgument(
        f"There is no {wanted} among the {len(selected)} selected episodes: "
        f"{listing([item.episode.name for item in selected], 20)}."
    )


def check_replan(item: SelectedEpisode, replan: int) -> int:
    """The replan's number, when the episode has it."""
    if not 0 <= replan < item.tokens.num_replans:
        raise BadArgument(
            f"There is no replan {replan} in {item.episode.name}; it has replans 0 to {item.tokens.num_replans - 1}."
        )
    return replan


def pieces_of(word: Word, prompt: Prompt) -> tuple[str, ...]:
    """The text of a word's tokens, without the space before them."""
    texts = {piece.key: prompt.text[piece.start : piece.stop].strip() for piece in prompt.pieces}
    return tuple(texts[key] for key in word.keys)


def preview_text(question: Question, preview: GroupPreview) -> str:
    """The preview as text: groups with their keys, words, what is shared and what is left over."""
    grouping, tokens = question.grouping, question.selected[0].tokens
    tasks = {(item.store.suite, item.episode.attributes.task_id) for item in question.selected}
    sharing = "groups may overlap" if grouping.overlap else "no key in two groups"
    lines = [
        f"Grouping '{grouping.name}': {len(grouping.names)} groups, {sharing}"
        + (f" ({grouping.description})" if grouping.description else ""),
        f"Site '{question.site}' with {tokens.layout.num_keys} keys; "
        f"{plural(len(question.selected), 'episode')} of {plural(len(tasks), 'task')}",
        *question.skipped,
        "",
        _groups_text(preview, grouping),
    ]
    lines += ["", *_words_text(preview)] if preview.words.height else []
    lines += ["", *_overlaps_text(preview)]
    if grouping.ratio is not None and preview.uniform_ratio is not None:
        sides = " / ".join(" + ".join(side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
        lines.append(f"Ratio {sides}: uniform attention alone gives {_range(*preview.uniform_ratio)}.")
    return "\n".join(wrapped for line in lines for wrapped in _wrap(line))


def _wrap(line: str) -> list[str]:
    """Sentences wrapped to the page; tables, which come as several lines, as they are."""
    return [line] if "\n" in line or not line else textwrap.wrap(line, WIDTH)


def _with_untaken(grouping: Grouping) -> Grouping:
    """The grouping with one more group for what no other takes, unless one of them is the rest already."""
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
        # A number that never changes in the episode counts once for each of its replans all the same.
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
        found: set[tuple[str, str, str, int]] = set()
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
                    found.add((names[int(i)], word.text.casefold(), "+".join(pieces).casefold(), len(pieces)))
        for key in found:
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


def _uniform_ratio(grouping: Grouping, resolved: Sequence[ResolvedGrouping]) -> tuple[float, float] | None:
    if grouping.ratio is None:
        return None
    top = [grouping.names.index(name) for name in grouping.ratio.numerator]
    bottom = [grouping.names.index(name) for name in grouping.ratio.denominator]
    values = np.concatenate(
        [ratio(item.num_keys[:, top].sum(axis=1), item.num_keys[:, bottom].sum(axis=1)) for item in resolved]
    )
    defined = values[~np.isnan(values)]
    return (float(defined.min()), float(defined.max())) if defined.size else None


def _range(low: float, high: float) -> str:
    first, last = format_number(low), format_number(high)
    return first if first == last else f"{first}..{last}"


def _groups_text(preview: GroupPreview, grouping: Grouping) -> str:
    rows, texts = [], []
    for name in preview.groups["group"].unique(maintain_order=True):
        parts = preview.groups.filter(pl.col("group") == name)
        total = parts.row(0, named=True)
        rows.append([name, _range(total["keys_min"], total["keys_max"])])
        taken = [
            f"{_range(part['keys_min'], part['keys_max'])} {part['role']} of {part['span']} ({part['span_keys']})"
            for part in parts.slice(1).iter_rows(named=True)
        ]
        selectors = " | ".join(grouping.groups[name]) if name in grouping.groups else ""
        texts.append(f"{', '.join(taken) or 'nothing'}{f'   <- {selectors}' if selectors else ''}")
    table = text_table(["group", "keys"], rows, left=(0,), last="of which (keys of the span) <- selector", texts=texts)
    return (
        f"{table}\nkeys: lowest..highest number over all replans; an object counts the area that it covers, in patches"
    )


def _words_text(preview: GroupPreview) -> list[str]:
    lines = []
    rows, texts = [], []
    for name in preview.words["group"].unique(maintain_order=True):
        words = preview.words.filter(pl.col("group") == name)
        rows.append([name, str(words["word"].n_unique())])
        shown = [
            row["word"] + (f" ({row['pieces']})" if row["num_pieces"] != 1 else "")
            for row in words.iter_rows(named=True)
        ]
        texts.append(listing(shown, 40))
    lines.append(
        text_table(["group", "words"], rows, left=(0,), last="which (pieces, where a word has several)", texts=texts)
    )
    return lines


def _overlaps_text(preview: GroupPreview) -> list[str]:
    lines = [
        f"Groups '{row['group']}' and '{row['other']}' share {_range(row['keys_min'], row['keys_max'])} keys."
        for row in preview.overlaps.iter_rows(named=True)
    ]
    untaken = preview.groups.filter(pl.col("group") == UNTAKEN)
    if untaken.height:
        parts = [f"{row['role']} of {row['span']}" for row in untaken.slice(1).iter_rows(named=True)]
        total = untaken.row(0, named=True)
        lines.append(f"No group takes {_range(total['keys_min'], total['keys_max'])} keys: {listing(parts)}.")
        lines.append("Their masses are in no fraction; add a group '*' to have them.")
    else:
        lines.append("Every key is in a group.")
    return lines
