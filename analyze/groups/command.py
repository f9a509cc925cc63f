"""`vla-attention groups`: what a grouping takes, before any number is computed."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_episode,
    add_grouping,
    add_pdf,
    add_site_and_tasks,
    add_stores,
    output_folder,
    output_place,
    question_of,
    show,
)
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention groups runs/libero_10.zarr --grouping cameras
  vla-attention groups runs/libero_10.zarr --grouping mine.toml --task 3 --episode 1 --replan 5
  vla-attention groups runs/libero_10.zarr --group nouns='word:bowl | word:plate' --group bowl=object:akita_black_bowl_1
  vla-attention groups runs/libero_10.zarr --group content=words:content --group stop=words:stop
  vla-attention groups runs/cosmos.zarr --site cross --group content=words:content

The language of selectors is in docs/groupings.md.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention groups STORE ...`."""
    parser = command_parser(
        "vla-attention groups",
        "What a grouping takes, before any number is computed: keys by span and role, words with their pieces, "
        "overlaps, what no group takes, and a picture of the patches. Reads no attention.",
        _EXAMPLES,
    )
    add_stores(parser)
    add_grouping(parser)
    add_site_and_tasks(parser.add_argument_group("selection"))
    example = add_episode(parser, "example in the picture")
    example.add_argument("--replan", type=int, default=0, metavar="N", help="its replan (default: 0)")
    output = parser.add_argument_group("output")
    output.add_argument("--output", type=output_place, metavar="PATH", help="folder (default: results/STORE/groups)")
    output.add_argument("--no-plots", action="store_true", help="text and tables only")
    add_pdf(output)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Print what the groups take; write tables and the picture."""
    from vla_attention.analyze.groups.group_preview import preview_groups
    from vla_attention.analyze.groups.text import preview_sections
    from vla_attention.analyze.measures.selected import check_replan, find_episode
    from vla_attention.analyze.show.answer import Answer

    question = question_of(arguments)
    example = find_episode(question.selected, None, arguments.episode)
    replan = check_replan(example, arguments.replan)
    preview = preview_groups(question)

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.groups.plot_patches import plot_group_patches

        return plot_group_patches(example, question.grouping, replan, folder)

    tables = {"groups": preview.groups, "group_words": preview.words, "group_overlaps": preview.overlaps}
    answer = Answer(preview_sections(question, preview), tables, draw, whole=True)
    return show(answer, output_folder(arguments, "groups"), arguments)
