"""`vla-attention ratios`, and `vla-attention analyze STORE` alone: masses, fractions and ratios with intervals."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import (
    add_output,
    add_question,
    add_sink_rule,
    add_stores,
    output_folder,
    settings_of,
    sink_rule,
    stores_of,
)
from vla_attention.analyze.registry import list_of_commands
from vla_attention.analyze.show.output_files import files_lines
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention analyze runs/libero_10.zarr
  vla-attention analyze runs/libero_10.zarr --list
  vla-attention analyze runs/libero_10.zarr --grouping cameras --layers 25 26 27
  vla-analyze runs/libero_10.zarr --group bowl='object:akita_black_bowl_1' --group noun=word:bowl --ratio bowl/noun
  vla-attention analyze runs/libero_10.zarr --without-sinks
  vla-attention heads runs/libero_10.zarr
  vla-attention compare runs/base.zarr runs/finetuned.zarr

`vla-analyze COMMAND --help` explains each command.
"""


#: What the process that draws imports while this one scans.
_DRAWING = ("vla_attention.analyze.ratios.default_plots", "matplotlib.figure", "matplotlib.backends.backend_agg")


def build_parser(prog: str = "vla-analyze") -> argparse.ArgumentParser:
    """The parser of `vla-attention analyze STORE ...` and `vla-attention ratios STORE ...`."""
    parser = command_parser(
        prog,
        "Masses, fractions and ratios from stored attention rows, for any grouping of tokens. Without the model.",
        f"commands (without one: ratios):\n{list_of_commands()}\n\n{_EXAMPLES}",
        usage=f"{prog} [COMMAND] STORE [STORE ...] [options]" if prog == "vla-analyze" else None,
    )
    add_stores(parser)
    parser.add_argument(
        "--list", action="store_true", help="print what the stores hold (layout, words, objects) and stop"
    )
    selection = add_question(parser)
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the steps table")
    sinks = parser.add_argument_group("sinks")
    sinks.add_argument(
        "--without-sinks",
        action="store_true",
        help="take keys that are sinks out of every group and of the valid keys, and list them (reads all rows)",
    )
    add_sink_rule(sinks)
    output = add_output(parser)
    output.add_argument("--save-viz", action="store_true", help="also a picture per episode and layer")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Analyse, print the summary, and write tables and pictures."""
    # Imported here, so that `--help` does not wait for polars and zarr.
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.measures.sinks import SinkRule
    from vla_attention.analyze.ratios.analysis import analyse, write_tables
    from vla_attention.analyze.ratios.screen_text import screen_text
    from vla_attention.analyze.stores.second_process import SecondProcess
    from vla_attention.schemas.errors import BadArgument

    stores = stores_of(arguments)
    if arguments.list:
        from vla_attention.analyze.stores.contents import describe_store

        print("\n\n".join(describe_store(store, arguments.tasks) for store in stores))
        return 0
    if not arguments.without_sinks and sink_rule(arguments) != SinkRule():
        raise BadArgument("--sink-factor and its like define a sink for --without-sinks; give --without-sinks too.")
    rule = sink_rule(arguments) if arguments.without_sinks else None
    question = ask(stores, settings_of(arguments))
    with SecondProcess(() if arguments.no_plots else _DRAWING) as second:
        analysis = analyse(question, without_sinks=rule)
        folder = output_folder(arguments, analysis.grouping.name)
        if arguments.no_plots:
            written = write_tables(analysis, folder)
        else:
            from vla_attention.analyze.ratios.default_plots import PlottedTables, write_plots, write_plots_of_episodes

            pictures = second.begin(write_plots, PlottedTables.of(analysis), folder)
            written = write_tables(analysis, folder) + pictures()
            if arguments.save_viz:
                written += write_plots_of_episodes(analysis, folder)
    print(screen_text(analysis, folder, files_lines(folder, written)))
    return 0
