"""`vla-analyze objects`: which objects are looked at, and how well attention finds them."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import (
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
)
from vla_attention.analyze.show.output_files import report_files
from vla_attention.schemas.command_line import OneSentenceParser

_EXAMPLES = """examples:
  vla-analyze objects runs/libero_10.zarr
  vla-analyze objects runs/libero_10.zarr --task 3 --episode 1
  vla-analyze objects runs/libero_10.zarr --layers 5 6 7 --per-head
  vla-analyze objects runs/libero_10.zarr --percentiles 75 90 --mask-coverage 0.3 --tolerance 0
  vla-analyze objects runs/libero_10.zarr --no-iou

Shares and lifts of 50 episodes take seconds; pointing game and IoU several times as long, and with --per-head that times the
number of heads.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze objects STORE ...`."""
    parser = OneSentenceParser(
        prog="vla-analyze objects",
        description="Which objects are looked at: share of the image attention and lift over covered area per object and class (of "
        "interest, other, robot, background); centre of attention, pointing game and IoU with the objects' masks, with chance levels.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_stores(parser)
    selection = add_selection(parser)
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
    maps.add_argument("--no-iou", action="store_true", help="shares and lifts only: no centres, pointing game and IoU")
    maps.add_argument(
        "--save-steps", action="store_true", help="also a table per replan, layer, denoise step and head (large)"
    )
    example = parser.add_argument_group("example in the picture")
    example.add_argument("--task", type=int, metavar="N", help="its task (default: the first one)")
    example.add_argument("--episode", type=int, metavar="N", help="its episode (default: the task's first one)")
    add_output(parser, "results/STORE/objects")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure the objects; print them, write tables and pictures."""
    from vla_attention.analyze.groups.group_preview import find_example
    from vla_attention.analyze.measures.aggregate import overall_layer
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.objects.object_attention import object_tables
    from vla_attention.analyze.objects.object_summary import (
        best_finders,
        iou_summary,
        objects_summary,
        objects_text,
        strongest_followers,
    )
    from vla_attention.analyze.objects.objects_in_view import ObjectSettings, site_of_pictures
    from vla_attention.analyze.show.output_files import write_parquet
    from vla_attention.schemas.stores.reader import open_store

    settings = ObjectSettings(
        percentiles=ObjectSettings.percentiles if arguments.percentiles is None else tuple(arguments.percentiles),
        mask_coverage=arguments.mask_coverage,
        tolerance=arguments.tolerance,
        spatial=not arguments.no_iou,
    )
    stores = [open_store(path) for path in arguments.stores]
    arguments.site = site_of_pictures(stores[0].attributes, arguments.site)
    question = ask(stores, settings_of(arguments))
    example = find_example(question.selected, arguments.task, arguments.episode)
    tables = object_tables(question, settings, arguments.save_steps)
    summary = objects_summary(tables.objects, arguments.seed)
    followers = strongest_followers(tables.objects)
    layer = overall_layer(tables.objects)
    to_write = {"objects": tables.objects, "object_times": tables.times, "objects_summary": summary}
    found = finders = None
    if tables.iou is not None:
        found = iou_summary(tables.iou, settings, arguments.seed)
        finders = best_finders(tables.iou, settings.thresholds[min(1, len(settings.thresholds) - 1)])
        to_write |= {"iou": tables.iou, "iou_summary": found}
    if tables.steps is not None:
        to_write["object_steps"] = tables.steps
    print(objects_text(question, summary, followers, found, finders, layer, settings))
    folder = output_folder(arguments, "objects")
    files = write_parquet(folder, **to_write)
    if not arguments.no_plots:
        from vla_attention.analyze.objects.plot_object_iou import plot_object_iou
        from vla_attention.analyze.objects.plot_object_shares import plot_object_shares

        files += plot_object_shares(tables.times, example, folder, arguments.seed)
        if found is not None:
            files += plot_object_iou(found, settings, folder, layer)
    report_files(folder, files)
    return 0
