"""Pictures for the page: small enough to be inside it, each with its vector version and its data to download."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.report.markup import data_uri, text

#: A table larger than this stays out of the page; the command that draws the picture writes it into a file.
MOST_DATA_BYTES = 200_000
_PNG_COLORS = 128
_WEBP_QUALITY = 72


@dataclass(frozen=True)
class Picture:
    """A drawn picture: what it shows, in words for those who do not see it, and a caption for all."""

    png: bytes
    alternative: str
    caption: str
    downloads: tuple[tuple[str, str, bytes], ...] = ()


def take(files: Sequence[Path], alternative: str, caption: str) -> Picture:
    """The picture that a drawing function has saved as png, pdf and csv."""
    of_kind = {path.suffix: path for path in files}
    downloads = []
    for suffix, kind in ((".pdf", "application/pdf"), (".csv", "text/csv")):
        path = of_kind.get(suffix)
        if path is not None and path.stat().st_size <= MOST_DATA_BYTES:
            downloads.append((path.name, kind, path.read_bytes()))
    return Picture(smaller_png(of_kind[".png"].read_bytes()), alternative, caption, tuple(downloads))


def smaller_png(png: bytes) -> bytes:
    """A diagram with a table of 128 colours, about a third of the size; the given bytes when that is no gain."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB").quantize(_PNG_COLORS, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", optimize=True)
    return min(buffer.getvalue(), png, key=len)


def photograph(image: NDArray[np.uint8], largest_side: int) -> str:
    """A camera picture (row, column, 3) as a data address (WebP), no side longer than `largest_side` pixels."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(image))
    picture.thumbnail((largest_side, largest_side))
    buffer = io.BytesIO()
    picture.save(buffer, format="WEBP", quality=_WEBP_QUALITY, method=4)
    return data_uri(buffer.getvalue(), "image/webp")


def png_uri(image: NDArray[np.uint8]) -> str:
    """A small picture (row, column, 3) as a data address, without loss."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="PNG", optimize=True)
    return data_uri(buffer.getvalue(), "image/png")


def figure(picture: Picture) -> str:
    """A picture on a light card, with its caption and its downloads."""
    links = ", ".join(
        f'<a download="{text(name)}" href="{data_uri(content, kind)}">{text(name.rpartition(".")[2].upper())}</a>'
        for name, kind, content in picture.downloads
    )
    saved = f' <span class="files">Save: {links}.</span>' if links else ""
    return (
        f'<figure class="card"><div class="picture"><img src="{data_uri(picture.png, "image/png")}" '
        f'alt="{text(picture.alternative)}"></div>'
        f"<figcaption>{text(picture.caption)}{saved}</figcaption></figure>"
    )


def drawn(draw: Callable[[Path], list[Path]], folder: Path, alternative: str, caption: str) -> str:
    """Draw into a folder, and give the figure for the page."""
    return figure(take(draw(folder), alternative, caption))
