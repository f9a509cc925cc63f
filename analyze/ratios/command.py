"""`vla-analyze ratios`, and `vla-analyze STORE` alone: masses, fractions and ratios, with intervals, tables and pictures."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import (
    add_grouping,
    add_output,
    add_selection,
    add_sink_rule,
    add_stores,
    output_folder,
    settings_of,
    sink_rule,
)
from vla_attention.analyze.commands import list_of_commands
from vla_attention.analyze.show.output_files import report_files
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-analyze runs/libero_10.zarr
  vla-analyze runs/libero_10.zarr --list
  vla-analyze runs/libero_10.zarr --grouping cameras --layers 25 26 27
  vla-analyze runs/libero_10.zarr --group bowl='object:akita_black_bowl_1' --group noun=word:bowl --ratio bowl/noun
  vla-analyze runs/libero_10.zarr --without-sinks
  vla-analyze heads runs/libero_10.zarr
  vla-analyze compare runs/base.zarr runs/finetuned.zarr

`vla-analyze COMMAND --help` has more of each.
"""


def build_parser(prog: str = "vla-analyze") -> argparse.ArgumentParser:
    """The parser of `vla-analyze STORE ...` and `vla-analyze ratios STORE ...`."""
    parser = command_parser(
        prog,
        "Masses, fractions and ratios from stored attention rows, for any grouping of tokens. Without the model.",
        f"commands (without one: ratios):\n{list_of_commands()}\n\n{_EXAMPLES}",
        usage=f"{prog} [COMMAND] STORE [STORE ...] [options]" if prog == "vla-analyze" else None,
    )
    add_stores(parser)
    parser.add_argument(
        "--list", action="store_true", help="say what the stores hold (layout, words, objects) and stop"
    )
    add_grouping(parser)
    selection = add_selection(parser)
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the steps table")
    sinks = parser.add_argument_group("sinks")
    sinks.add_argument(
        "--without-sinks",
        action="store_true",
        help="take keys that are sinks out of every group and of the valid keys, and say which (reads all selected rows)",
    )
    add_sink_rule(sinks)
    output = add_output(parser)
    output.add_argument("--save-viz", action="store_true", help="also a picture per episode and layer")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Analyse, print the summary, and write tables and pictures."""
    # Imported after the arguments were read: `--help` must not wait for polars and zarr.
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.ratios.analysis import analyse, write_tables
    from vla_attention.schemas.errors import BadArgument
    from vla_attention.schemas.stores.reader import open_store

    stores = [open_store(path) for path in arguments.stores]
    if arguments.list:
        from vla_attention.analyze.stores.contents import describe_store

        print("\n\n".join(describe_store(store, arguments.tasks) for store in stores))
        return 0
    question = ask(stores, settings_of(arguments))
    sinks = None
    if arguments.without_sinks:
        from vla_attention.analyze.measures.sinks import sinks_table, without_sinks

        rule = sink_rule(arguments)
        sinks = sinks_table(question, rule)
        question = without_sinks(question, sinks, rule)
    elif arguments.sink_factor is not None or arguments.sink_share is not None:
        raise BadArgument("--sink-factor and --sink-share say what a sink is for --without-sinks; give that too.")
    analysis = analyse(question)
    folder = output_folder(arguments, question.grouping.name)
    written = write_tables(analysis, folder)
    if sinks is not None:
        from vla_attention.analyze.show.output_files import write_parquet

        written.files += write_parquet(folder, sinks=sinks)
    print(analysis.summary)
    if not arguments.no_plots:
        from vla_attention.analyze.ratios.default_plots import write_plots

        written.files += write_plots(analysis, folder, arguments.save_viz)
    report_files(folder, written.files)
    return 0
