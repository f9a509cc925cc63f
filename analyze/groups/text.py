"""What a grouping takes, as printed text: groups with their keys, words, shared keys and keys that no group takes."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.groups.group_preview import UNTAKEN, GroupPreview
from vla_attention.analyze.measures.baselines import baseline_notes
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.headings import wrap
from vla_attention.analyze.show.numbers import format_number, of_tasks
from vla_attention.analyze.show.text_table import text_table
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping


def preview_text(question: Question, preview: GroupPreview) -> str:
    """The preview as text: groups with their keys, words, what is shared and what is left over."""
    grouping, tokens = question.grouping, question.selected[0].tokens
    sharing = "groups may overlap" if grouping.overlap else "no key in two groups"
    lines = [
        f"Grouping '{grouping.name}': {len(grouping.names)} groups, {sharing}"
        + (f" ({grouping.description})" if grouping.description else ""),
        f"Site '{question.site}' with {tokens.layout.num_keys} keys; "
        f"{of_tasks(len(question.selected), question.num_tasks)}",
        *question.skipped,
        "",
        _groups_text(preview, grouping),
    ]
    lines += ["", *_words_text(preview)] if preview.words.height else []
    lines += ["", *_overlaps_text(preview)]
    if grouping.ratio is not None and preview.uniform_ratio is not None:
        sides = " / ".join(" + ".join(side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
        lines.append(f"Ratio {sides}: uniform attention alone gives {_range(*preview.uniform_ratio)}.")
        lines += baseline_notes(question.stores)
    return "\n".join(wrapped for line in lines for wrapped in _wrapped(line))


def _wrapped(line: str) -> list[str]:
    """Sentences are wrapped; tables, which are several lines already, are not."""
    return [line] if "\n" in line or not line else wrap(line)


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
