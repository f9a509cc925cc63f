"""Pictures for the page, small enough to be inside it. Diagrams come with a vector version and their data to save."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

#: A table larger than this stays out of the page; the command that draws the picture writes it into a file.
MOST_DATA_BYTES = 200_000
_PNG_COLORS = 128
_WEBP_QUALITY = 72
_DOWNLOADS = {".pdf": "application/pdf", ".csv": "text/csv"}


@dataclass(frozen=True)
class Download:
    """A file inside the page."""

    name: str
    address: str
    label: str


@dataclass(frozen=True)
class Diagram:
    """A drawn picture. `alternative` describes it to people who do not see it, `caption` stands below it."""

    template: ClassVar[str] = "diagram.html"
    address: str
    alternative: str
    caption: str
    downloads: Sequence[Download] = ()


def drawn(draw: Callable[[Path], list[Path]], folder: Path, alternative: str, caption: str) -> Diagram:
    """Draw into a folder; the diagram for the page."""
    return diagram_of(draw(folder), alternative, caption)


def diagram_of(files: Sequence[Path], alternative: str, caption: str) -> Diagram:
    """The diagram that a drawing function saved as png, pdf and csv."""
    picture = next(path for path in files if path.suffix == ".png")
    downloads = []
    for path in files:
        if path.suffix in _DOWNLOADS and path.stat().st_size <= MOST_DATA_BYTES:
            # A second table is named by the rest of its name: CSV, CSV groups.
            rest = path.stem.removeprefix(picture.stem).replace("_", " ")
            address = data_address(path.read_bytes(), _DOWNLOADS[path.suffix])
            downloads.append(Download(path.name, address, f"{path.suffix[1:].upper()}{rest}"))
    png = data_address(smaller_png(picture.read_bytes()), "image/png")
    return Diagram(png, alternative, caption, downloads)


def data_address(content: bytes, kind: str) -> str:
    """A file as an address that needs no network."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def smaller_png(png: bytes) -> bytes:
    """A diagram with a table of 128 colours, about a third of the size; the given bytes when that is not smaller."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png), formats=("PNG",)).convert("RGB")
    picture = picture.quantize(_PNG_COLORS, dither=Image.Dither.NONE)
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
    return data_address(buffer.getvalue(), "image/webp")


def png_address(image: NDArray[np.uint8]) -> str:
    """A small picture (row, column, 3) as a data address, without loss."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="PNG", optimize=True)
    return data_address(buffer.getvalue(), "image/png")
