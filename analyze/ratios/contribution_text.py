"""The summary's sections on contribution norms."""

from __future__ import annotations

import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG, TableInParts, Tables, cells_in_parts
from vla_attention.analyze.measures.group_contributions import have_ratio, norms_by_layer, ratios_by_layer
from vla_attention.analyze.ratios.summary_text import ratio_columns
from vla_attention.analyze.show.answer import Section
from vla_attention.analyze.show.headings import WIDTH
from vla_attention.analyze.show.tables import Cell, Column, Table, number, texts
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.errors import listing
from vla_attention.schemas.groupings.grouping import Grouping

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


def contributions_table(contributions: pl.DataFrame) -> Table:
    """`contribution_rows` of both sides, in a text and on the page."""
    columns = [
        Column("layer", lambda row: row["layer"], lambda row: Cell(row["layer"], row["layer_number"]), "layer", True),
        number("|visual|", "visual_norm", "visual norm"),
        number("|linguistic|", "linguistic_norm", "linguistic norm"),
        *ratio_columns(bounds_of_lift=True),
        number(None, "ratio_mean", "mean"),
    ]
    caption = (
        "Norms of contributions. Ratio, uniform, lift: geometric means. Uniform: the ratio that the same values would "
        "give if attention were shared out between the segments as uniform attention is; lift: ratio / uniform"
    )
    return Table(columns, contributions.to_dicts(), caption)


def contribution_sections(contributions: pl.DataFrame) -> list[Section]:
    """What image keys and text keys add, from `contribution_rows` of both sides."""
    title = "CONTRIBUTIONS  |visual| / |linguistic|, norms of what the keys add to the residual stream"
    note = f"{_HOW} Norms of different sites may be divided; masses may not. {_RATIO_NOTE}"
    return [Section([contributions_table(contributions)], title), Section([note])]


def group_contribution_sections(
    tables: Tables | None, grouping: Grouping, site: str, sampling: Sampling, first: bool = True
) -> list[Section]:
    """Per layer the groups' mean norms and the ratio of norms with its interval.

    `first`: whether no `contribution_sections` stand above.
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
        return [Section([note], title)]
    adding = tables.groups_with("norm")
    shown = [name for name in measured if name in adding]
    nothing = [name for name in measured if name not in shown]
    if nothing:
        note = f"The keys of {listing(nothing)} add exactly nothing. {note}".strip()
    if first:
        note = f"{_HOW} {note}".strip()
    norms, ratios = norms_by_layer(tables), ratios_by_layer(tables, sampling)
    rows = [
        {f"norm {name}": norms[layer, name] for name in shown} | ratios.get(layer, {}) | {"layer": layer}
        for layer in (*tables.parts[0].cells["layer"].unique(maintain_order=True).cast(pl.String), LAYERS_AVG)
    ]
    layer = texts("layer", "layer", left=True)
    of_norms = [number(f"|{name}|", f"norm {name}") for name in shown]
    of_ratios = ratio_columns(bounds_of_lift=True) if ratios else []
    together = Table([layer, *of_norms, *of_ratios], rows)
    below = [Section([f"{_RATIO_NOTE if ratios else ''} {note}".strip()])]
    if not ratios or max(map(len, str(together).splitlines())) <= WIDTH:
        return [Section([together], title), *below]
    return [Section([Table([layer, *of_norms], rows)], title), Section([Table([layer, *of_ratios], rows)]), *below]
