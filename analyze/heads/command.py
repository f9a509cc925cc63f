"""`vla-attention heads`: heads, layers and denoise steps; entropy, sinks, depth."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_output,
    add_question,
    add_sink_rule,
    add_stores,
    output_folder,
    question_of,
    show,
    sink_rule,
)
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention heads runs/libero_10.zarr
  vla-attention heads runs/libero_10.zarr --layers 5 6 7 --top 10
  vla-attention heads runs/libero_10.zarr --group bowl=object:akita_black_bowl_1 --group words=role:instruction \\
      --ratio bowl/words
  vla-attention heads runs/libero_10.zarr --sink-factor 20 --sink-share 0.25
  vla-attention heads runs/libero_10.zarr --no-rows     (masses only: a moment, also for large stores)

A sink of a head is a key that takes more than --sink-factor times its uniform share in at least --sink-share of the
head's rows, or more than --sink-mass of a row on average (then also more than twice its uniform share); sinks are
found task by task.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention heads STORE ...`."""
    parser = command_parser(
        "vla-attention heads",
        "Who looks and who reads: the most visual and most linguistic heads, how much heads differ, layers, depth and "
        "denoise steps, with intervals; and of single rows entropy, effective number of keys, "
        "mass of the largest keys and sinks.",
        _EXAMPLES,
    )
    add_stores(parser)
    add_question(parser)
    rows = parser.add_argument_group("rows and heads")
    rows.add_argument("--top", type=int, default=5, metavar="N", help="heads listed on either end (default: 5)")
    rows.add_argument(
        "--top-k",
        type=int,
        nargs="+",
        default=[1, 5, 10],
        metavar="K",
        help="numbers of largest keys (default: 1 5 10)",
    )
    rows.add_argument(
        "--no-rows", action="store_true", help="do not read the rows: no entropy, no largest keys, no sinks"
    )
    add_sink_rule(rows)
    add_output(parser, "results/STORE/heads")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure; print the text, write tables and pictures."""
    from vla_attention.analyze.heads.head_study import study_heads
    from vla_attention.analyze.heads.row_metrics import RowOptions
    from vla_attention.analyze.heads.text import heads_sections
    from vla_attention.analyze.show.answer import Answer
    from vla_attention.schemas.errors import BadArgument

    if arguments.top < 1:
        raise BadArgument(f"--top {arguments.top} lists no head; expected at least 1.")
    options = None if arguments.no_rows else RowOptions(tuple(arguments.top_k), sink_rule(arguments))
    study = study_heads(question_of(arguments), options)

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.heads.layer_time import layer_time_table
        from vla_attention.analyze.heads.plot_denoise_profile import plot_denoise_profile
        from vla_attention.analyze.heads.plot_head_grid import plot_head_grid
        from vla_attention.analyze.heads.plot_layer_time import plot_layer_time
        from vla_attention.analyze.ratios.plot_layer_profile import plot_layer_profile

        grouping = study.question.grouping
        time = layer_time_table(study.replans, grouping, study.question.sampling)
        return [
            *plot_head_grid(study.heads, grouping, folder),
            *plot_layer_profile(study.tasks, grouping, folder),
            *plot_layer_time(time, study.replans, grouping, folder),
            *plot_denoise_profile(study.denoise, grouping, folder),
        ]

    answer = Answer(heads_sections(study, arguments.top), study.files(), draw)
    return show(answer, output_folder(arguments, "heads"), arguments)
