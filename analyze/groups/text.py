"""What a grouping takes, as printed text: groups with their keys, words, shared keys and keys that no group takes."""

from __future__ import annotations

from vla_attention.analyze.groups.group_preview import UNTAKEN, GroupPreview
from vla_attention.analyze.measures.baselines import baseline_notes
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.numbers import format_number, of_tasks
from vla_attention.analyze.show.tables import Table, texts
from vla_attention.analyze.stores.run_notes import run_notes
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping


def preview_sections(question: Question, preview: GroupPreview) -> list[Section]:
    """Groups with their keys, words, what is shared and what is left over."""
    grouping, tokens = question.grouping, question.selected[0].tokens
    sharing = "groups may overlap" if grouping.overlap else "no key in two groups"
    about = [
        f"Grouping '{grouping.name}': {len(grouping.names)} groups, {sharing}"
        + (f" ({grouping.description})" if grouping.description else ""),
        f"Site '{question.site}' with {tokens.layout.num_keys} keys; "
        f"{of_tasks(len(question.selected), question.num_tasks)}",
        *question.skipped,
    ]
    notes = [*run_notes(question.episodes), *_overlaps(preview)]
    if grouping.ratio is not None and preview.uniform_ratio is not None:
        sides = " / ".join(" + ".join(side) for side in (grouping.ratio.numerator, grouping.ratio.denominator))
        notes.append(f"Ratio {sides}: uniform attention alone gives {_range(*preview.uniform_ratio)}.")
        notes += baseline_notes(question.stores)
    words = [Section([_words_table(preview)])] if preview.words.height else []
    keys = "keys: lowest..highest number over all replans; an object counts the area that it covers, in patches"
    return [Section(about), Section([_groups_table(preview, grouping), [keys]]), *words, Section(notes)]


def _range(low: float, high: float) -> str:
    first, last = format_number(low), format_number(high)
    return first if first == last else f"{first}..{last}"


def _groups_table(preview: GroupPreview, grouping: Grouping) -> Table:
    rows = []
    for name in preview.groups["group"].unique(maintain_order=True):
        total, *parts = preview.groups.filter(group=name).to_dicts()
        taken = [
            f"{_range(part['keys_min'], part['keys_max'])} {part['role']} of {part['span']} ({part['span_keys']})"
            for part in parts
        ]
        selectors = " | ".join(grouping.groups[name]) if name in grouping.groups else ""
        which = f"{', '.join(taken) or 'nothing'}{f'   <- {selectors}' if selectors else ''}"
        rows.append((name, _range(total["keys_min"], total["keys_max"]), which))
    return _table(rows, "keys", "of which (keys of the span) <- selector")


def _words_table(preview: GroupPreview) -> Table:
    rows = []
    for name in preview.words["group"].unique(maintain_order=True):
        words = preview.words.filter(group=name)
        shown = [
            row["word"] + (f" ({row['pieces']})" if row["num_pieces"] != 1 else "")
            for row in words.iter_rows(named=True)
        ]
        rows.append((name, str(words["word"].n_unique()), listing(shown, 40)))
    return _table(rows, "words", "which (pieces, where a word has several)")


def _table(rows: list[tuple[str, str, str]], number: str, running: str) -> Table:
    columns = [
        texts("group", lambda row: row[0], left=True),
        texts(number, lambda row: row[1]),
        texts(running, lambda row: row[2], running=True),
    ]
    return Table(columns, rows)


def _overlaps(preview: GroupPreview) -> list[str]:
    lines = [
        f"Groups '{row['group']}' and '{row['other']}' share {_range(row['keys_min'], row['keys_max'])} keys."
        for row in preview.overlaps.iter_rows(named=True)
    ]
    untaken = preview.groups.filter(group=UNTAKEN)
    if untaken.is_empty():
        return [*lines, "Every key is in a group."]
    total, *parts = untaken.to_dicts()
    named = listing([f"{row['role']} of {row['span']}" for row in parts])
    lines.append(f"No group takes {_range(total['keys_min'], total['keys_max'])} keys: {named}.")
    return [*lines, "Their masses are in no fraction; add a group '*' to have them."]
