"""Tables as files for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from vla_attention.analyze.measures.frames import TableInParts, Tables, named_parts
from vla_attention.analyze.ratios.analysis import Analysis
from vla_attention.analyze.show.output_files import write_csv, write_parquet
from vla_attention.schemas.errors import BadArgument


def chosen_tables(analysis: Analysis, names: Sequence[str]) -> dict[str, TableInParts]:
    """Tables of an analysis by the names of their files.

    Steps, replans, episodes and tasks are two tables each, NAME and NAME_groups.

    Raises:
        BadArgument: contributions are wanted and were not recorded.
    """
    tables: dict[str, TableInParts] = {}
    for name in names:
        table: Tables | TableInParts | None = getattr(analysis, name)
        if table is None:
            raise BadArgument(
                "These stores hold no contributions; record them with vla-attention capture "
                "--contributions, or choose other tables."
            )
        tables |= named_parts(name, table) if isinstance(table, Tables) else {name: table}
    return tables


def write_tables(folder: Path, tables: Mapping[str, TableInParts], kinds: Sequence[str]) -> list[Path]:
    """Write tables in each of the kinds `csv` and `parquet`; returns the paths."""
    written = []
    if "csv" in kinds:
        written += write_csv(folder, **tables)
    if "parquet" in kinds:
        written += write_parquet(folder, **tables)
    return written
