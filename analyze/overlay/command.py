"""`vla-analyze overlay`: attention on the stored pictures, as strips and as a video."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.arguments import (
    add_grouping,
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
)
from vla_attention.analyze.show.output_files import report_files
from vla_attention.schemas.command_line import OneSentenceParser

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vla_attention.analyze.overlay.overlay_data import EpisodeOverlay
    from vla_attention.schemas.groupings.grouping import Grouping

_EXAMPLES = """examples:
  vla-analyze overlay runs/libero_10.zarr
  vla-analyze overlay runs/libero_10.zarr --task 3 --episode 1 --layers 13 --heads 5
  vla-analyze overlay runs/libero_10.zarr --group bowl=object:akita_black_bowl_1 --video gif
  vla-analyze overlay runs/libero_10.zarr --replans 0 5 10 --camera base_0_rgb --measure share
  vla-analyze overlay runs/cosmos.zarr --site self --video mp4 --fps 4

--group outlines the patches of which a group takes at least half; the ratio is that of --grouping.
"""
_STRIP_REPLANS = 6
_DEFAULT_FPS = 4.0


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze overlay STORE ...`."""
    parser = OneSentenceParser(
        prog="vla-analyze overlay",
        description="Attention laid over the stored pictures of one episode, right way round, with one scale for all "
        "of them: a "
        "strip of some replans (PNG, PDF, and the numbers as CSV), and a video with the ratio's curve beside it.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_stores(parser)
    episode = parser.add_argument_group("episode")
    episode.add_argument("--task", type=int, metavar="N", help="its task (default: the first one)")
    episode.add_argument("--episode", type=int, metavar="N", help="its episode (default: the task's first one)")
    episode.add_argument(
        "--replans", type=int, nargs="+", metavar="N",
        help=f"replans of the strip (default: {_STRIP_REPLANS}, from the first to the last)",
    )  # fmt: skip
    episode.add_argument("--camera", nargs="+", metavar="NAME", help="cameras (default: all that the policy sees)")
    add_selection(parser)
    add_grouping(parser)
    look = parser.add_argument_group("drawing")
    look.add_argument(
        "--measure", choices=("lift", "share"), default="lift",
        help="lift: mass of a patch / mean mass of a valid key; share: per cent of all image attention (default: lift)",
    )  # fmt: skip
    look.add_argument("--smooth", action="store_true", help="bilinear between patches (default: patches as they are)")
    look.add_argument("--video", choices=("gif", "mp4"), help="also a video of the whole episode")
    look.add_argument(
        "--fps", type=float, default=_DEFAULT_FPS, metavar="X", help=f"replans a second (default: {_DEFAULT_FPS:g})"
    )
    add_output(parser, "results/STORE/overlay")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Draw one episode."""
    from dataclasses import replace

    from vla_attention.analyze.groups.group_preview import find_example
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.overlay.overlay_data import (
        camera_names,
        check_outlines,
        chosen_replans,
        episode_overlay,
        orientation_note,
        outline_grouping,
        overlay_table,
        ratios_of,
    )
    from vla_attention.analyze.overlay.video import check_video
    from vla_attention.analyze.ratios.analysis import describe_heads
    from vla_attention.schemas.errors import BadArgument, listing
    from vla_attention.schemas.stores.reader import open_store

    if arguments.video:
        if arguments.no_plots:
            raise BadArgument("--no-plots and --video contradict each other; give one of them.")
        check_video(arguments.video)
    stores = [open_store(path) for path in arguments.stores]
    settings = settings_of(arguments)
    groups = outline_grouping(settings.groups)
    question = ask(stores, replace(settings, groups=()))
    check_outlines(question, groups)
    cameras = camera_names(question, arguments.camera)
    item = find_example(question.selected, arguments.task, arguments.episode)
    overlay = episode_overlay(question, item, cameras, ratios_of(question, item), groups)
    replans = chosen_replans(overlay, arguments.replans, _STRIP_REPLANS)
    for line in question.skipped:
        print(line)
    print(_text(overlay, replans))
    note = orientation_note(overlay)
    print(f"\n{note}" if note else "")
    folder = output_folder(arguments, "overlay")
    suite = f"{item.store.suite}_" if len(stores) > 1 else ""
    stem = f"overlay_{suite}{item.episode.name}"
    files = []
    selection = question.selection
    about = (
        f"mean over layers {listing(selection.layer_labels, 8)}, denoise steps {listing(selection.denoise_steps, 8)}, "
        f"{describe_heads(selection, stores[0].attributes.policy.num_heads).removeprefix('mean over ')}"
    )
    if not arguments.no_plots:
        from vla_attention.analyze.overlay.plot_strip import plot_overlay_strip

        files += plot_overlay_strip(
            overlay,
            question.grouping,
            replans,
            folder,
            stem,
            measure=arguments.measure,
            smooth=arguments.smooth,
            about=about,
        )
    if arguments.video:
        files.append(_write_video(arguments, overlay, question.grouping, folder / f"{stem}.{arguments.video}"))
    if arguments.no_plots or arguments.video:
        from vla_attention.analyze.show.output_files import replacing

        path = folder / f"{stem}_all.csv"
        with replacing(path) as temporary:
            overlay_table(overlay, range(overlay.num_replans)).write_csv(temporary)
        files.append(path)
    report_files(folder, files)
    return 0


def _write_video(arguments: argparse.Namespace, overlay: EpisodeOverlay, grouping: Grouping, path: Path) -> Path:
    """The whole episode, with progress at a terminal."""
    from vla_attention.analyze.overlay.plot_video_frames import video_frames
    from vla_attention.analyze.overlay.video import write_video
    from vla_attention.analyze.show.progress import progress_bar

    with progress_bar(overlay.num_replans, "pictures") as advance:

        def counted() -> Iterator[NDArray[np.uint8]]:
            for frame in video_frames(overlay, grouping, measure=arguments.measure, smooth=arguments.smooth):
                advance(1)
                yield frame

        return write_video(path, counted(), arguments.fps, arguments.video)


def _text(overlay: EpisodeOverlay, replans: tuple[int, ...]) -> str:
    """A line per replan of the strip: ratio, each camera's share of image attention, its brightest patch."""
    from vla_attention.analyze.show.numbers import format_number
    from vla_attention.analyze.show.patch_pictures import upright
    from vla_attention.analyze.show.text_table import text_table

    attributes = overlay.item.episode.attributes
    header = ["replan", "step", *(["ratio"] if overlay.ratio is not None else [])]
    for camera in overlay.maps:
        header += [f"{camera} %", "most", "at"]
    lift, rows = overlay.values("lift"), []
    for replan in replans:
        cells = [str(replan), str(overlay.env_step[replan])]
        if overlay.ratio is not None:
            cells.append(format_number(float(overlay.ratio[replan])))
        for camera, mass in overlay.maps.items():
            shown = upright(lift[camera][replan], overlay.views[camera])
            place = divmod(int(shown.argmax()), shown.shape[1])
            share = (
                100 * mass[replan].sum() / overlay.image_mass[replan] if overlay.image_mass[replan] else float("nan")
            )
            cells += [format_number(float(share)), format_number(float(shown.max())), f"{place[0]},{place[1]}"]
        rows.append(cells)
    heading = f"{overlay.item.store.suite} {overlay.item.episode.name}: {attributes.instruction}"
    legend = (
        "%: camera's share of all image attention. most, at: highest lift of a patch, and its row,column in the "
        "picture as it is "
        "shown (numbers in the csv's row and column count as selectors do, in the stored picture)."
    )
    return "\n".join([heading, text_table(header, rows), *textwrap.wrap(legend, 100)])
