"""Pictures of a data set, PNG and JPEG only: pillow starts Ghostscript for an EPS, whatever its file is called."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.limits import PICTURE_PIXELS, PICTURE_SIDE

#: How a PNG and a JPEG begin.
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"


class PictureRefused(ValueError):
    """Bytes that are no picture of these formats, or a damaged one; the text completes "it ..."."""


def decode_picture(content: bytes) -> NDArray[np.uint8]:
    """Return a picture, (height, width, 3) uint8 RGB, in an array of its own.

    Raises:
        PictureRefused: it is no PNG and no JPEG, is larger than a picture is, or is damaged.
    """
    from PIL import JpegImagePlugin, PngImagePlugin

    if not content.startswith((_PNG, _JPEG)):
        raise PictureRefused("cannot be decoded: it is no PNG and no JPEG")
    # Not by `Image.open`, which warns of large pictures before their size is known here.
    kind = PngImagePlugin.PngImageFile if content.startswith(_PNG) else JpegImagePlugin.JpegImageFile
    try:
        with kind(io.BytesIO(content)) as image:
            width, height = image.size
            if max(width, height) > PICTURE_SIDE or width * height > PICTURE_PIXELS:
                raise PictureRefused(
                    f"has {width:,} x {height:,} pixels; expected at most {PICTURE_SIDE:,} on a side and "
                    f"{PICTURE_PIXELS:,} in all"
                )
            return np.array(image.convert("RGB"))  # a copy: torch warns of arrays that cannot be written
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, PictureRefused):
            raise
        raise PictureRefused(f"cannot be decoded ({(str(error) or type(error).__name__).splitlines()[0]})") from error
