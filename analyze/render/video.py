"""Pictures as a moving one: GIF through pillow, MP4 through the ffmpeg of imageio-ffmpeg. Each file appears whole."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.result import Figure
from vla_attention.analyze.render.files import replacing
from vla_attention.analyze.render.pictures import pictures
from vla_attention.analyze.render.style import Style
from vla_attention.schemas.errors import BadArgument, MissingDependency
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    from PIL.Image import Image

VideoFormat = Literal["gif", "mp4"]
#: Colours in a GIF, which has one table for all pictures.
_GIF_COLORS = 255
#: Quality of H.264, from 0 to 51, the worst.
_CRF = 15


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float, kind: VideoFormat) -> Path:
    """Write pictures (row, column, 3) uint8 of one size, `fps` of them a second; returns the path.

    Raises:
        BadArgument: no picture, pictures of different sizes, or a rate outside 0.1 to 50 pictures a second.
        MissingDependency: MP4 without imageio-ffmpeg.
        OSError: the file cannot be written.
    """
    if not 0.1 <= fps <= 50:
        raise BadArgument(f"Cannot write {fps} pictures a second; expected --fps from 0.1 to 50.")
    try:
        with replacing(path) as temporary:
            (write_gif if kind == "gif" else write_mp4)(temporary, frames, fps)
    except subprocess.CalledProcessError as error:
        said = error.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {error.returncode}"]
        raise BadArgument(f"ffmpeg could not write {path}: {visible(said[-1])}; choose --video gif.") from None
    return path


def write_film(path: Path, figure: Figure, fps: float, kind: VideoFormat) -> None:
    """A figure of kind `pictures` as a film: for each of its columns the rows side by side, all of one size."""
    write_video(path, _film(figure), fps, kind)


def _film(figure: Figure) -> Iterator[NDArray[np.uint8]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    style, frame = Style(), figure.frame.with_columns(pl.col("row").cast(pl.String))
    named = frame["row"].n_unique() > 1
    above = pl.format("{}\n{}", "row", "above") if named else pl.col("above")
    told = {tuple(words) for words in frame["words"].drop_nulls()} if "words" in frame.columns else ()
    figure = replace(figure, options={**figure.options, "sentences": told})
    with style.settings():
        for part in frame.partition_by("column", maintain_order=True):
            side_by_side = part.with_columns(row=pl.lit(0), column="row", above=above)
            canvas = pictures(replace(figure, frame=side_by_side), style).canvas
            assert isinstance(canvas, FigureCanvasAgg)
            canvas.draw()  # type: ignore[no-untyped-call]
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def check_video(kind: VideoFormat) -> None:
    """Raise `MissingDependency` when that kind cannot be written here; before anything is computed."""
    if kind == "mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise MissingDependency(
                f"Writing MP4 needs imageio-ffmpeg, which is not installed; {install_line('video')}, or choose "
                "--video gif."
            ) from None


def write_gif(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write an endless GIF. Its colours are chosen for all pictures together, so that a small cube stays green."""
    from PIL import Image

    drawn = [Image.fromarray(frame) for frame in _same_size(frames)]
    sheet = Image.fromarray(_colours_of(drawn))
    palette = sheet.quantize(_GIF_COLORS, method=Image.Quantize.MEDIANCUT, kmeans=1)
    # Without dithering: noise would change from picture to picture, look like content, and triple the file.
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in drawn]
    indexed[0].save(
        path, format="GIF", save_all=True, append_images=indexed[1:], duration=round(1000 / fps), loop=0, optimize=False
    )


def _colours_of(pictures: Sequence[Image]) -> NDArray[np.uint8]:
    """A picture (1, number, 3) of the colours of all pictures; the more pixels one has, the more often, by root."""
    coarse = (np.asarray(picture, dtype=np.uint32) >> 2 for picture in pictures)
    codes = ((one[..., 0] << 12) | (one[..., 1] << 6) | one[..., 2] for one in coarse)
    found = [np.unique(one, return_counts=True) for one in codes]
    colours, place = np.unique(np.concatenate([one for one, _ in found]), return_inverse=True)
    often = np.ceil(np.sqrt(np.bincount(place, np.concatenate([counts for _, counts in found])))).clip(1, 8)
    parts = np.stack([colours >> 12, (colours >> 6) & 63, colours & 63], axis=-1) * 255 // 63
    return np.repeat(parts, often.astype(int), axis=0)[None].astype(np.uint8)


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write H.264 that every player shows (4:2:0, even sides: an odd last row or column is repeated).

    ffmpeg is started here and not by imageio-ffmpeg, which does not tell that it has failed: on a full disk, a part of
    a video would pass for all of it.

    Raises:
        CalledProcessError: ffmpeg ended with an error.
    """
    check_video("mp4")
    import imageio_ffmpeg

    drawn = list(_same_size(frames))
    height, width = drawn[0].shape[:2]
    even = ((0, height % 2), (0, width % 2), (0, 0))
    given = f"-f rawvideo -vcodec rawvideo -s {width + width % 2}x{height + height % 2} -pix_fmt rgb24"
    given += f" -r {Fraction(fps).limit_denominator()} -i -"
    made = f"-an -vcodec libx264 -pix_fmt yuv420p -crf {_CRF} -v error -f mp4 -movflags +faststart"
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-y", *given.split(), *made.split(), str(path)],
        input=b"".join(np.pad(picture, even, mode="edge").tobytes() for picture in drawn),
        capture_output=True,
        check=True,
        process_group=0,  # Ctrl-C is for this process, which then ends ffmpeg
    )


def _same_size(frames: Iterable[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    first: tuple[int, ...] = ()
    for frame in frames:
        first = first or frame.shape
        if frame.shape != first:
            raise BadArgument(f"A video's pictures have one size; got {frame.shape} after {first}.")
        yield frame
    if not first:
        raise BadArgument("A video needs at least one picture.")
