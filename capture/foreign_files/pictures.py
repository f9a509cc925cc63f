"""Pictures of a data set, PNG and JPEG only: pillow starts Ghostscript for an EPS, whatever its file is called."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

#: What is decoded. A data set has its pictures in one of these two.
FORMATS = ("PNG", "JPEG")


class PictureRefused(ValueError):
    """Bytes that are no picture of these formats, or a damaged one; the text completes "it ..."."""


def decode_picture(content: bytes) -> NDArray[np.uint8]:
    """Return a picture, (height, width, 3) uint8 RGB, in an array of its own.

    Raises:
        PictureRefused: it is no PNG and no JPEG, or is damaged.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(content), formats=FORMATS) as image:
            return np.array(image.convert("RGB"))  # a copy: torch warns of arrays that cannot be written
    except UnidentifiedImageError:
        raise PictureRefused("cannot be decoded: it is no PNG and no JPEG") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise PictureRefused(f"cannot be decoded ({str(error).splitlines()[0]})") from error
