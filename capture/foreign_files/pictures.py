"""Pictures of a data set, PNG and JPEG only: pillow starts Ghostscript for an EPS, whatever its file is called.

A few hundred bytes can say that they are 100,000 x 100,000 pixels. Their size is read before they are decoded.
"""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.limits import PICTURE_BYTES, PICTURE_PIXELS, PICTURE_SCANS, PICTURE_SIDE

#: How a PNG and a JPEG begin, and each scan of a JPEG; in its pixels these two bytes do not occur.
_PNG, _JPEG, _SCAN = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"\xff\xda"


class PictureRefused(ValueError):
    """Bytes that are no picture of these formats, or a damaged one; the text completes "it ..."."""


def decode_picture(content: bytes) -> NDArray[np.uint8]:
    """Return a picture, (height, width, 3) uint8 RGB, in an array of its own.

    Raises:
        PictureRefused: it is no PNG and no JPEG, is larger than a picture is, or is damaged.
    """
    from PIL import JpegImagePlugin, PngImagePlugin

    if len(content) > PICTURE_BYTES:
        raise PictureRefused(f"has {len(content):,} bytes; expected at most {PICTURE_BYTES:,}")
    if content.startswith(_JPEG) and content.count(_SCAN) > PICTURE_SCANS:
        raise PictureRefused(f"is a JPEG of {content.count(_SCAN):,} scans; expected at most {PICTURE_SCANS}")
    if not content.startswith((_PNG, _JPEG)):
        raise PictureRefused("cannot be decoded: it is no PNG and no JPEG")
    # Not by `Image.open`, which warns of large pictures on the terminal before their size is known here.
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
