"""`vla-attention objects`: which objects are looked at, and how well attention finds them."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_episode,
    add_intervals,
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
    show,
    stores_of,
)
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention objects runs/libero_10.zarr
  vla-attention objects runs/libero_10.zarr --task 3 --episode 1
  vla-attention objects runs/libero_10.zarr --layers 5 6 7 --per-head
  vla-attention objects runs/libero_10.zarr --percentiles 75 90 --mask-coverage 0.3 --tolerance 0
  vla-attention objects runs/libero_10.zarr --no-iou

Shares, enrichment and control of 50 episodes take seconds; pointing game and IoU several times as long, and with
--per-head that times the number of heads.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention objects STORE ...`."""
    parser = command_parser(
        "vla-attention objects",
        "Which objects are looked at: share of the image attention, enrichment over covered area and over the object's "
        "masks of other episodes (a control for attention that is fixed to a place), per object and class (of "
        "interest, other, robot, background); centre of attention, pointing game and IoU with the objects' masks, with "
        "chance levels.",
        _EXAMPLES,
    )
    add_stores(parser)
    selection = add_selection(parser)
    add_intervals(parser)
    selection.add_argument("--per-head", action="store_true", help="keep heads apart instead of averaging their maps")
    maps = parser.add_argument_group("maps and masks")
    maps.add_argument(
        "--percentiles",
        type=float,
        nargs="+",
        metavar="P",
        help="thresholds of the attended region (default: 80 90 95)",
    )
    maps.add_argument(
        "--mask-coverage",
        type=float,
        default=0.5,
        metavar="SHARE",
        help="a patch is the object's when it covers at least this share of it (default: 0.5)",
    )
    maps.add_argument(
        "--tolerance", type=float, default=1.0, metavar="PATCHES", help="of the pointing game (default: 1 patch)"
    )
    maps.add_argument("--no-iou", action="store_true", help="no centres, pointing game and IoU")
    maps.add_argument(
        "--save-steps", action="store_true", help="also a table per replan, layer, denoise step and head (large)"
    )
    add_episode(parser, "example in the picture")
    add_output(parser, "results/STORE/objects")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure the objects; print them, write tables and pictures."""
    from vla_attention.analyze.objects.object_settings import ObjectSettings
    from vla_attention.analyze.objects.object_study import study_objects
    from vla_attention.analyze.objects.text import objects_sections
    from vla_attention.analyze.show.answer import Answer

    stores, settings = stores_of(arguments), settings_of(arguments)
    study = study_objects(
        stores,
        settings,
        ObjectSettings(
            percentiles=ObjectSettings.percentiles if arguments.percentiles is None else tuple(arguments.percentiles),
            mask_coverage=arguments.mask_coverage,
            tolerance=arguments.tolerance,
            spatial=not arguments.no_iou,
        ),
        keep_steps=arguments.save_steps,
        task=None,
        episode=arguments.episode,
    )

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.objects.plot_object_iou import plot_object_iou
        from vla_attention.analyze.objects.plot_object_shares import plot_object_shares

        return [*plot_object_shares(study, folder), *(plot_object_iou(study, folder) if not arguments.no_iou else [])]

    answer = Answer(objects_sections(study), study.files(), draw)
    return show(answer, output_folder(arguments, "objects"), arguments)
