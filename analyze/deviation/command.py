"""`vla-attention deviation`: how far the policy's actions are from the data set's, beside attention."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_grouping,
    add_intervals,
    add_output,
    add_selection,
    add_stores,
    output_folder,
    question_of,
    show,
)
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention deviation runs/droid.zarr
  vla-attention deviation runs/droid.zarr --grouping cameras --layers 10 11 12
  vla-attention deviation runs/droid.zarr --group bowl=word:bowl --ratio visual/bowl

The store needs the data set's own actions: vla-attention capture replay stores them.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention deviation STORE ...`."""
    parser = command_parser(
        "vla-attention deviation",
        "How far the policy's actions are from those of the data set that it was replayed over:\n"
        "by dimension in units of the data set's spread, first action and chunk, by task and phase,\n"
        "and whether the deviation goes with where the policy looks.",
        _EXAMPLES,
    )
    add_stores(parser)
    add_selection(parser)
    add_grouping(parser)
    add_intervals(parser)
    add_output(parser, "results/STORE/deviation")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Compare the actions; print the comparison, write the tables and the picture."""
    from vla_attention.analyze.deviation.deviation_study import study_deviation
    from vla_attention.analyze.deviation.text import deviation_sections
    from vla_attention.analyze.show.answer import Answer

    study = study_deviation(question_of(arguments))

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.deviation.plot_deviation import plot_deviation

        return plot_deviation(study, folder)

    answer = Answer(deviation_sections(study), study.tables(), draw)
    return show(answer, output_folder(arguments, "deviation"), arguments)
