"""`vla-attention time`: over the course of an episode, around the first gripper closing, success against failure."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import add_output, add_question, add_stores, output_folder, question_of, show
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention time runs/libero_10.zarr
  vla-attention time runs/libero_10.zarr --layers 25 --bins 10
  vla-attention time runs/libero_10.zarr --grouping objects --window 5
  vla-attention time runs/libero_goal.zarr runs/libero_10.zarr --no-plots

A replan's value holds until the next replan, as its actions do; a bin of the episode's time is the
mean of that step function. The gripper closes at the first replan one of whose executed actions has a
last number above 0 (robosuite's Panda gripper, which every suite of vla-capture drives).
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention time STORE ...`."""
    parser = command_parser(
        "vla-attention time",
        "Ratio and fractions over the course of an episode and around the first gripper closing,\n"
        "success against failure with effect sizes, and how many independent replans an episode is worth.",
        _EXAMPLES,
    )
    add_stores(parser)
    time = parser.add_argument_group("time")
    time.add_argument("--bins", type=int, default=20, metavar="N", help="parts of an episode's time (default: 20)")
    time.add_argument(
        "--window", type=int, default=8, metavar="N", help="replans shown before and after the closing (default: 8)"
    )
    add_question(parser)
    add_output(parser, "results/STORE/time")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; write tables and pictures."""
    from vla_attention.analyze.effects.over_time import over_time_of_stores
    from vla_attention.analyze.effects.text import over_time_sections
    from vla_attention.analyze.show.answer import Answer
    from vla_attention.analyze.time.text import time_sections
    from vla_attention.analyze.time.time_courses import TimeSettings, time_courses

    settings = TimeSettings(arguments.bins, arguments.window)
    question = question_of(arguments)
    courses = time_courses(question, settings)
    effects = over_time_of_stores(question.stores, question.settings, settings.num_bins)

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.effects.plot_effects_over_time import plot_effects_over_time
        from vla_attention.analyze.time.plot_time_course import plot_time_courses

        files = plot_time_courses(courses, question.grouping, folder)
        return files + (plot_effects_over_time(effects, folder) if effects is not None else [])

    tables = {
        "time_course": courses.course,
        "gripper_closing": courses.closing,
        "gripper_change": courses.change,
        "success_against_failure": courses.outcomes,
        "autocorrelation": courses.autocorrelation,
    }
    sections = time_sections(question, courses, settings)
    if effects is not None:
        tables["effects_over_time"] = effects.course
        sections[2:2] = over_time_sections(effects)  # after the course of attention
    answer = Answer(sections, tables, draw)
    return show(answer, output_folder(arguments, "time"), arguments)
