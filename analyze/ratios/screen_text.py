"""What `vla-attention analyze STORE` prints: the answer in three sentences, then one compact table per question.

At most `SCREEN_LINES` lines with those about the files; `summary_text` has the whole, for summary.txt.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from math import ceil
from pathlib import Path

import polars as pl

from vla_attention.analyze.measures.aggregate import HEADLINE, layer_order, overall_layer, overall_rows
from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.ratios.summary_text import ratio_columns
from vla_attention.analyze.show.answer import SCREEN_LINES, WHOLE_TEXT
from vla_attention.analyze.show.headings import WIDTH, wrap, wrap_all
from vla_attention.analyze.show.numbers import format_number, format_percent, row_interval
from vla_attention.analyze.show.plot_text import shortened
from vla_attention.analyze.show.tables import INTERVAL, Table, count, number, percent, percent_interval, texts

#: Rows of groups, and blocks of layers beside each other, before "in summary.txt" stands for the rest.
_MOST_GROUPS, _MOST_BLOCKS = 6, 2
#: Notes leave room for so many tasks, and many groups for as many as these.
_FEWEST_TASKS, _FEWEST_GROUPS = 3, 2
_REST = f"in {WHOLE_TEXT}"
_PROGRAM = "vla-attention"
#: Groups whose fractions stand in rows where there is no ratio.
_MOST_FRACTIONS = 3


def screen_text(analysis: Analysis, folder: Path, files: Sequence[str]) -> str:
    """The lines to print.

    Args:
        analysis: the tables.
        folder: where summary.txt is.
        files: the lines about further files, which stand last.
    """
    last = [*wrap(f"The whole, with every interval: {folder / WHOLE_TEXT}", rest="  "), *files]
    answer, layers, groups = wrap_all(analysis.answer), _layers(analysis), _groups(analysis, _MOST_GROUPS)
    room = SCREEN_LINES - len(answer) - len(layers) - len(groups) - len(last) - 4
    notes = _notes(analysis, room - _FEWEST_TASKS - 3)
    room -= len(notes) + bool(notes)
    if room < _FEWEST_TASKS + 2:  # header, and that there are more
        fewer = _groups(analysis, max(_FEWEST_GROUPS, _MOST_GROUPS - _FEWEST_TASKS - 2 + room))
        groups, room = fewer, room + len(groups) - len(fewer)
    above = [*answer, "", *notes, *([""] if notes else []), *layers, "", *groups, ""]
    pages = _pages(analysis)
    if room - len(pages) > _FEWEST_TASKS + 2:  # header, and that there are more
        room, last = room - len(pages), [*last, *pages]
    return "\n".join([*above, *_tasks(analysis, room), "", *last])


def _pages(analysis: Analysis) -> list[str]:
    """The commands that show the same as pages, as they can be typed here."""
    # `make analyze` calls a program that is not on the PATH.
    program = sys.argv[0] if Path(sys.argv[0]).name == _PROGRAM and shutil.which(_PROGRAM) is None else _PROGRAM
    stores = shlex.join(str(store.path) for store in analysis.question.stores)
    lines = [f"One page of it: {program} report {stores} --open", f"To explore it: {program} view {stores}"]
    if max(map(len, lines)) <= WIDTH:
        return lines
    return [f"One page of it: {program} report STORE --open; to explore it: {program} view STORE"]


def _notes(analysis: Analysis, room: int) -> list[str]:
    """The notes; where they are too long the first line of each, which names what it is about."""
    notes, most = [wrap(f"note: {note}", rest="  ") for note in analysis.notes], max(room, 2)
    if sum(map(len, notes)) <= most:
        return [line for lines in notes for line in lines]
    shown = notes if len(notes) <= most - 1 else notes[: most - 2]
    more = len(notes) - len(shown)
    rest = f"  {more} more notes {_REST}" if more else f"  ... the whole of the notes {_REST}"
    return [*(lines[0] for lines in shown), rest]


def _layers(analysis: Analysis) -> list[str]:
    """Layers beside each other: ratio and lift, or fractions, and the ratio of the norms of contributions."""
    level = overall_rows(analysis.tasks)
    cells = {row["layer"]: row for row in level.cells.iter_rows(named=True)}
    layers = [layer for layer in layer_order(level.cells) if layer != LAYERS_AVG]
    rows: dict[str, list[str]] = {}
    if analysis.grouping.ratio is not None:
        title = "LAYERS  ratio, and its lift over uniform attention"
        for label, column in (("ratio", HEADLINE), ("lift", "ratio_lift")):
            rows[label] = [format_number(cells[layer][column]) for layer in layers]
    else:
        title = "LAYERS  fractions of the summed masses"
        of_group = level.by_group("layer")
        for name in analysis.present_groups[:_MOST_FRACTIONS]:
            rows[shortened(name, 14)] = [format_percent(of_group[layer, name]["fraction"]) for layer in layers]
    below = ""
    if analysis.contribution_rows is not None:
        norms = {row["layer"]: row for row in analysis.contribution_rows.iter_rows(named=True)}
        rows["|v| / |l|"] = [format_number(norms[layer][HEADLINE]) for layer in layers]
        whole = norms[LAYERS_AVG]
        bounds = row_interval(whole, HEADLINE)
        below = "CONTRIBUTIONS  |v| / |l|, norms of what all image and all text keys add, whatever the grouping: "
        below += f"{format_number(whole[HEADLINE])}{'' if bounds == '-' else f' {bounds}'}"
        below += f"; uniform {format_number(whole['uniform_ratio'])}, lift {format_number(whole['ratio_lift'])}"
    return [title, *_beside_each_other("layer", layers, rows), *wrap(below, rest="  ")]


def _beside_each_other(name: str, columns: Sequence[str], rows: Mapping[str, Sequence[str]]) -> list[str]:
    """A table with many columns as blocks of equal width below each other, without rules."""
    labels = max(map(len, [name, *rows]))
    width = max((len(cell) for cells in (columns, *rows.values()) for cell in cells), default=1) + 1
    fit = (WIDTH - labels - 1) // width
    blocks = ceil(len(columns) / fit)
    shown = columns if blocks <= _MOST_BLOCKS else columns[: fit * _MOST_BLOCKS]
    per_block = ceil(len(shown) / min(blocks, _MOST_BLOCKS))
    lines = []
    for start in range(0, len(shown), per_block):
        for label, cells in ((name, columns), *rows.items()):
            part = cells[start : min(start + per_block, len(shown))]
            lines.append(f"{label.ljust(labels)} " + "".join(cell.rjust(width) for cell in part))
    more = len(columns) - len(shown)
    return [*lines, f"{more} more {name}s {_REST}"] if more else lines


def _groups(analysis: Analysis, most: int) -> list[str]:
    """The groups that get attention, at most so many, over all tasks and layers."""
    rows = [{"name": name} | analysis.overall_groups[name] for name in analysis.present_groups]
    rows = [row for row in rows if row["mass"]]
    columns = [
        texts("GROUPS", lambda row: shortened(row["name"], 40), left=True),
        number("keys", "keys"),
        percent("fraction", "fraction"),
        percent_interval("fraction", INTERVAL),
        number("lift", "lift"),
    ]
    table, more = _without_rule(Table(columns, rows[:most])), len(rows) - most
    return [*table, f"{more} more groups {_REST}"] if more > 0 else table


def _tasks(analysis: Analysis, room: int) -> list[str]:
    """The tasks, or the suites where there are several, as many as `room` lines hold."""
    tasks = analysis.tasks.filter(pl.col("layer") == overall_layer(analysis.tasks.cells))
    several = tasks.cells["suite"].drop_nulls().n_unique() > 1
    level = tasks.filter(pl.col("scope") == ("all" if several else "task"))
    noun, cells = ("suite" if several else "task"), list(level.cells.iter_rows(named=True))
    fits = len(cells) if len(cells) < room else max(room - 2, 0)
    groups = () if analysis.grouping.ratio is not None else analysis.present_groups[:_MOST_FRACTIONS]
    of_group = level.by_group("suite", "task_id")
    rows = [
        row | {f"fraction {name}": of_group[row["suite"], row["task_id"], name]["fraction"] for name in groups}
        for row in cells[:fits]
    ]
    columns = [
        texts(f"{noun.upper()}S", lambda row: row["suite"] if several else str(row["task_id"]), left=True),
        count("n", "num_episodes"),
        percent("solved", "success_rate", decimals=0),
        *(ratio_columns()[:4] if analysis.grouping.ratio is not None else []),
        *(percent(shortened(name, 14), f"fraction {name}") for name in groups),
    ]
    head, *lines = _without_rule(Table(columns, rows))
    if not several:
        # What is left of the width, on one line each.
        width = max(map(len, [head, *lines]))
        room = WIDTH - width - 2
        said = [
            textwrap.shorten(row["instruction"] or "", room, placeholder=" ...") if room > 0 else "" for row in rows
        ]
        lines = [f"{line:<{width}}  {text}".rstrip() for line, text in zip(lines, said, strict=True)]
    left = len(cells) - fits
    return [head, *lines, *([f"{left} more {noun}s {_REST}"] if left else [])]


def _without_rule(table: Table) -> list[str]:
    head, rows = table.laid_out()
    return [*head, *(line for row in rows for line in row)]
