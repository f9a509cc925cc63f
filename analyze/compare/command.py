"""`vla-attention compare`: two or more runs, paired where they share initial states and seeds."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import add_output, add_question, settings_of, show
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention compare runs/base.zarr runs/finetuned.zarr
  vla-attention compare base=runs/base.zarr tuned=runs/finetuned.zarr other=runs/other.zarr --layers 8 9
  vla-attention compare base=runs/b_spatial.zarr,runs/b_goal.zarr tuned=runs/t_spatial.zarr,runs/t_goal.zarr
  vla-attention compare runs/libero_spatial.zarr runs/libero_goal.zarr --allow-mismatch suite

Episodes pair when suite, task, initial state and seed are equal, and a rerun of the first run (vla-capture
rerun) at every replan; vla-attention effects tells how its actions change. Everything but the weights and their
names must agree, or be allowed by name: family, suite, seed, protocol, image_size, wait_steps, replan_steps, max_steps,
layers, denoise_steps, heads, queries, depth, layout, cameras, processing, simulator.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention compare RUN RUN ...`."""
    parser = command_parser(
        "vla-attention compare",
        "Differences of other runs to the first one, per task, layer and overall, with intervals;\n"
        "paired where runs share initial states and seeds.",
        _EXAMPLES,
    )
    parser.add_argument(
        "runs",
        nargs="+",
        metavar="RUN",
        help="STORE, or NAME=STORE[,STORE ...] for a run of several stores; two or more",
    )
    parser.add_argument(
        "--allow-mismatch",
        action="append",
        default=[],
        metavar="FIELD",
        help="compare although the runs differ in this field; may be repeated",
    )
    add_question(parser)
    add_output(parser, "results/A-vs-B/compare")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Print the comparison; write tables and pictures."""
    from vla_attention.analyze.compare.comparison import compare_stores
    from vla_attention.analyze.compare.runs import parse_runs
    from vla_attention.analyze.compare.text import comparison_sections
    from vla_attention.analyze.show.answer import Answer
    from vla_attention.analyze.show.plot_text import shortened

    comparison = compare_stores(parse_runs(arguments.runs), settings_of(arguments), arguments.allow_mismatch)

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.compare.plot_forest import plot_forest
        from vla_attention.analyze.compare.plot_paired_differences import plot_paired_differences

        files = plot_forest(comparison, folder)
        for name in comparison.runs_with_common_tasks:
            files += plot_paired_differences(comparison, name, folder)
        return files

    tables = {
        "comparison": comparison.differences,
        "pairs": comparison.pairs,
        "runs": comparison.estimates,
        "unpaired": comparison.unpaired,
    }
    if not comparison.effects.is_empty():
        tables["effects"] = comparison.effects
    joined = shortened("-vs-".join(comparison.names).replace("/", "-"), 100)
    folder = arguments.output or Path("results") / joined / "compare"
    return show(Answer(comparison_sections(comparison), tables, draw), folder, arguments)
