"""`vla-attention export`: tables as CSV or Parquet, masses and rows as NetCDF."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import add_question, add_stores, output_folder, output_place, question_of
from vla_attention.analyze.show.output_files import files_lines
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.errors import BadArgument

_TABLES = ("steps", "replans", "episodes", "tasks", "contributions", "effects")
_DEFAULT_TABLES = ("episodes", "tasks", "steps")
_EXAMPLES = """examples:
  vla-attention export runs/libero_10.zarr --csv
  vla-attention export runs/libero_10.zarr --parquet --table steps --per-head --grouping cameras
  vla-attention export runs/libero_10.zarr --netcdf --group bowl=word:bowl --group rest='*'
  vla-attention export runs/libero_10.zarr --netcdf --rows --layers 25 --tasks 0

Tables: steps (every replan, layer and denoise step), replans, episodes, tasks (with intervals); contributions
(norms) and effects (of every replan and condition), where recorded. The NetCDF file, attention.nc, has (episode,
replan) as one axis `sample`, so that nothing is padded; open it with xarray.open_dataset, or with any program that
reads HDF5.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention export STORE ...`."""
    parser = command_parser(
        "vla-attention export",
        "Numbers for other programs: tables as CSV or Parquet; masses, and rows if wanted, as NetCDF.",
        _EXAMPLES,
    )
    add_stores(parser)
    kinds = parser.add_argument_group("kinds (at least one)")
    kinds.add_argument("--csv", action="store_true", help="tables as NAME.csv")
    kinds.add_argument("--parquet", action="store_true", help="tables as NAME.parquet")
    kinds.add_argument("--netcdf", action="store_true", help="masses as attention.nc (needs the extra 'xarray')")
    kinds.add_argument(
        "--table",
        action="append",
        choices=_TABLES,
        metavar="NAME",
        help=f"which table; may be repeated: {', '.join(_TABLES)} (default: {', '.join(_DEFAULT_TABLES)})",
    )
    kinds.add_argument(
        "--rows", action="store_true", help="with --netcdf: also the rows themselves; their size is printed first"
    )
    selection = add_question(parser)
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the steps table")
    output = parser.add_argument_group("output")
    output.add_argument("--output", type=output_place, metavar="PATH", help="folder (default: results/STORE/export)")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Write the tables and arrays."""
    kinds = [kind for kind in ("csv", "parquet", "netcdf") if getattr(arguments, kind)]
    tables_wanted = arguments.csv or arguments.parquet
    if not kinds:
        raise BadArgument("Nothing to export to; give --csv, --parquet or --netcdf, or several of them.")
    if arguments.rows and not arguments.netcdf:
        raise BadArgument("--rows goes with --netcdf: rows do not fit into a table.")
    if arguments.table and not tables_wanted:
        raise BadArgument("--table goes with --csv or --parquet; --netcdf always holds masses.")
    question = question_of(arguments)
    for line in question.remarks:
        print(line)
    folder = output_folder(arguments, "export")
    written: list[Path] = []
    if tables_wanted:
        from vla_attention.analyze.export.tables import chosen_tables, write_tables
        from vla_attention.analyze.measures.frames import TableInParts
        from vla_attention.analyze.ratios.analysis import analyse

        names = list(dict.fromkeys(arguments.table or _DEFAULT_TABLES))
        of_attention = [name for name in names if name != "effects"]
        tables: dict[str, TableInParts] = chosen_tables(analyse(question), of_attention) if of_attention else {}
        if "effects" in names:
            from vla_attention.analyze.export.recorded_effects import effect_table

            tables["effects"] = TableInParts([effect_table(question)])
        written += write_tables(folder, tables, kinds)
    if arguments.netcdf:
        from vla_attention.analyze.export.labelled_arrays import rows_size, write_netcdf
        from vla_attention.schemas.progress_bar import progress_bar

        if arguments.rows:
            print(f"rows: {rows_size(question)}, before compression")
        with progress_bar(len(question.selected) * (1 + arguments.rows), "episodes") as advance:
            written.append(write_netcdf(question, folder / "attention.nc", arguments.rows, advance))
    print("\n".join(files_lines(folder, written)))
    return 0
