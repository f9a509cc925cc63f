"""Pictures as a moving one: GIF through pillow, MP4 through imageio-ffmpeg. Each file appears whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.show.output_files import replacing
from vla_attention.schemas.errors import BadArgument, MissingDependency

VideoFormat = Literal["gif", "mp4"]
#: Colours in a GIF, which has one table for all pictures.
_GIF_COLORS = 255


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, kind: VideoFormat) -> Path:
    """Write pictures (row, column, 3) uint8 of one size, `fps` of them a second; returns the path.

    Raises:
        BadArgument: no picture, pictures of different sizes, or a rate outside 0.1 to 50 pictures a second.
        MissingDependency: MP4 without imageio-ffmpeg.
    """
    if not 0.1 <= fps <= 50:
        raise BadArgument(f"Cannot write {fps} pictures a second; expected --fps from 0.1 to 50.")
    with replacing(path) as temporary:
        (write_gif if kind == "gif" else write_mp4)(temporary, frames, fps)
    return path


def check_video(kind: VideoFormat) -> None:
    """Raise `MissingDependency` when that kind cannot be written here; before anything is computed."""
    if kind == "mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise MissingDependency(
                "Writing MP4 needs imageio-ffmpeg, which is not installed; pip install 'vla-attention[video]', or "
                "choose --video gif."
            ) from None


def write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write an endless GIF. Its colours are chosen for the first, the middle and the last picture together."""
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in _same_size(frames)]
    samples = [pictures[i] for i in sorted({0, len(pictures) // 2, len(pictures) - 1})]
    sheet = Image.new("RGB", (samples[0].width, sum(sample.height for sample in samples)))
    for i, sample in enumerate(samples):
        sheet.paste(sample, (0, i * sample.height))
    palette = sheet.quantize(_GIF_COLORS, method=Image.Quantize.MEDIANCUT)
    # Without dithering: noise would change from picture to picture, look like content, and triple the file.
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    indexed[0].save(
        path, format="GIF", save_all=True, append_images=indexed[1:], duration=round(1000 / fps), loop=0, optimize=False
    )


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write H.264 that every player shows (4:2:0, even sides: an odd last row or column is repeated)."""
    check_video("mp4")
    import imageio_ffmpeg

    writer = None
    try:
        for frame in _same_size(frames):
            height, width = frame.shape[:2]
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                writer = imageio_ffmpeg.write_frames(
                    str(path), (even.shape[1], even.shape[0]), fps=fps, codec="libx264", macro_block_size=2, quality=7,
                    ffmpeg_log_level="error", output_params=["-f", "mp4", "-movflags", "+faststart"],
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
    finally:
        if writer is not None:
            writer.close()


def _same_size(frames: Iterable[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    first: tuple[int, ...] | None = None
    for frame in frames:
        if first is None:
            first = frame.shape
        if frame.shape != first:
            raise BadArgument(f"A video's pictures have one size; got {frame.shape} after {first}.")
        yield frame
    if first is None:
        raise BadArgument("A video needs at least one picture.")
