"""`vla-attention overlay`: attention on the stored pictures, as strips and as a video."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_episode,
    add_grouping,
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
    stores_of,
)
from vla_attention.analyze.show.output_files import write_csv, writing
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.errors import BadArgument

_EXAMPLES = """examples:
  vla-attention overlay runs/libero_10.zarr
  vla-attention overlay runs/libero_10.zarr --task 3 --episode 1 --layers 13 --heads 5
  vla-attention overlay runs/libero_10.zarr --group bowl=object:akita_black_bowl_1 --video gif
  vla-attention overlay runs/libero_10.zarr --replans 0 5 10 --camera base_0_rgb --measure share
  vla-attention overlay runs/cosmos.zarr --site self --video mp4 --fps 4

--group outlines the patches of which a group takes at least half; the ratio is that of --grouping.
"""
_STRIP_REPLANS = 6
_DEFAULT_FPS = 4.0


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention overlay STORE ...`."""
    parser = command_parser(
        "vla-attention overlay",
        "Attention laid over the stored pictures of one episode, right way round, with one scale for all "
        "of them: a "
        "strip of some replans (PNG, and the numbers as CSV), and a video with the ratio's curve beside it.",
        _EXAMPLES,
    )
    add_stores(parser)
    episode = add_episode(parser, "episode")
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
        help="lift: mass of a patch over uniform attention; share: per cent of all image attention (default: lift)",
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
    from vla_attention.analyze.overlay.overlay_study import study_overlay
    from vla_attention.analyze.overlay.text import overlay_sections
    from vla_attention.analyze.overlay.video import check_video
    from vla_attention.analyze.show.answer import Answer

    if arguments.video:
        if arguments.no_plots:
            raise BadArgument("--no-plots and --video contradict each other; give one of them.")
        check_video(arguments.video)
    study = study_overlay(
        stores_of(arguments),
        settings_of(arguments),
        task=None,
        episode=arguments.episode,
        cameras=arguments.camera,
        replans=arguments.replans,
        most_replans=_STRIP_REPLANS,
    )

    def draw(folder: Path) -> list[Path]:
        """The strip, the video and the numbers, as far as they were asked for."""
        files: list[Path] = []
        with writing("pictures", folder):
            if not arguments.no_plots:
                from vla_attention.analyze.overlay.plot_strip import plot_overlay_strip

                files += plot_overlay_strip(study, folder, measure=arguments.measure, smooth=arguments.smooth)
            if arguments.video:
                from vla_attention.analyze.overlay.plot_video_frames import write_overlay_video

                path = folder / f"{study.stem}.{arguments.video}"
                look = {"measure": arguments.measure, "smooth": arguments.smooth}
                files.append(write_overlay_video(study, path, arguments.fps, **look))
            if arguments.no_plots or arguments.video:
                files += write_csv(folder, **{f"{study.stem}_all": study.whole_table})
        return files

    answer = Answer(overlay_sections(study), draw=draw, whole=True)
    return answer.show(output_folder(arguments, "overlay"), pictures=True)
