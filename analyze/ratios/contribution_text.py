"""The summary's sections on contribution norms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG, TableInParts, Tables, cells_in_parts
from vla_attention.analyze.measures.group_contributions import have_ratio, norms_by_layer, ratios_by_layer
from vla_attention.analyze.show.headings import WIDTH, heading, wrap
from vla_attention.analyze.show.numbers import format_number, interval_name, row_interval
from vla_attention.analyze.show.text_table import text_table
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.analyze.statistics.intervals import DEFAULT_LEVEL
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping

_RATIO_HEADER = ("ratio", interval_name(DEFAULT_LEVEL), "uniform", "lift", "interval", "of means")
_RATIO_NOTE = (
    "ratio, uniform, lift: geometric means; lift is ratio / uniform. uniform: the ratio that the same values would "
    "give if attention were shared out between the segments as uniform attention is. of means: mean norm / mean "
    "norm."
)
_HOW = (
    "Value-weighted, through output projection and gate; root mean square over action queries, mean over replans and "
    "denoise steps."
)


def same_sides(contributions: TableInParts, tables: Tables | None) -> bool:
    """Whether the ratio of a grouping's groups is that of `contribution_table` at every replan, layer and step."""
    if tables is None or not have_ratio(tables):
        return False
    ratio = "contribution_ratio"
    return all(a[ratio].equals(b[ratio]) for a, b in zip(cells_in_parts(tables), contributions, strict=True))


def contributions_section(contributions: pl.DataFrame) -> str:
    """The summary's section: `contribution_rows` of both sides as text."""
    rows = [
        [row["layer"], format_number(row["visual_norm"]), format_number(row["linguistic_norm"]), *_ratio_cells(row)]
        for row in contributions.iter_rows(named=True)
    ]
    title = "CONTRIBUTIONS  |visual| / |linguistic|, norms of what the keys add to the residual stream"
    note = f"{_HOW} Norms of different sites may be divided; masses may not. {_RATIO_NOTE}"
    header = ["layer", "|visual|", "|linguistic|", *_RATIO_HEADER]
    return "\n".join([heading(title), text_table(header, rows, left=(0,)), "", *wrap(note), ""])


def group_contributions_section(
    tables: Tables | None, grouping: Grouping, site: str, sampling: Sampling, first: bool = True
) -> str:
    """The summary's section: per layer the groups' mean norms and the ratio of norms with its interval.

    `first`: whether no `contributions_section` stands above it.
    """
    title = f"norms of what they add to the residual stream at site '{site}'"
    title = f"CONTRIBUTIONS OF GROUPS  {title}" if first else f"OF GROUPS  {title}"
    measured = () if tables is None else tables.group_names()
    cut = [name for name in grouping.names if name not in measured]
    note = (
        f"Not of {listing(cut)}: contributions are stored for whole segments (a span's keys of one role), and "
        f"{'this group takes' if len(cut) == 1 else 'these groups take'} parts of segments."
        if cut
        else ""
    )
    if tables is None:
        return "\n".join([heading(title), *wrap(note), ""])
    adding = tables.groups_with("norm")
    shown = [name for name in measured if name in adding]
    nothing = [name for name in measured if name not in shown]
    if nothing:
        note = f"The keys of {listing(nothing)} add exactly nothing. {note}".strip()
    if first:
        note = f"{_HOW} {note}".strip()
    norms = norms_by_layer(tables)
    ratios = ratios_by_layer(tables, sampling)
    layers, of_norms, of_ratios = [], [], []
    for layer in (*tables.parts[0].cells["layer"].unique(maintain_order=True).cast(pl.String), LAYERS_AVG):
        layers.append(layer)
        of_norms.append([format_number(norms[layer, name]) for name in shown])
        of_ratios.append(_ratio_cells(ratios[layer]) if layer in ratios else [])
    header = [f"|{name}|" for name in shown]
    table = _beside(layers, (header, of_norms), (list(_RATIO_HEADER), of_ratios)) if ratios else ""
    if not ratios or max(map(len, table.splitlines())) > WIDTH:
        table = _beside(layers, (header, of_norms))
        if ratios:
            table += "\n\n" + _beside(layers, (list(_RATIO_HEADER), of_ratios))
    note = f"{_RATIO_NOTE if ratios else ''} {note}".strip()
    lines = [heading(title), table]
    return "\n".join([*lines, *(["", *wrap(note)] if note else []), ""])


def _beside(layers: Sequence[str], *parts: tuple[list[str], list[list[str]]]) -> str:
    """One table of parts (header, cells of every layer) that stand beside one another."""
    header = ["layer", *(name for names, _ in parts for name in names)]
    rows = [[layer, *(cell for _, cells in parts for cell in cells[i])] for i, layer in enumerate(layers)]
    return text_table(header, rows, left=(0,))


def _ratio_cells(row: Mapping[str, Any]) -> list[str]:
    cells = [format_number(row["geometric_mean"]), row_interval(row, "geometric_mean")]
    cells += [format_number(row["uniform_ratio"]), format_number(row["ratio_lift"]), row_interval(row, "ratio_lift")]
    return [*cells, format_number(row["ratio_of_means"])]
