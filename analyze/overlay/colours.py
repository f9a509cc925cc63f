"""Attention laid over pictures: colours, opacity and scale of overlays, colours of outlined groups. Pure functions.

To change how overlays look, change the constants below. Which pixels a patch has is in `show/patch_pictures.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.show.patch_pictures import NO_PICTURE, enlarge
from vla_attention.schemas.errors import BadArgument

Measure = Literal["lift", "share"]
MEASURES: tuple[Measure, ...] = ("lift", "share")
#: Perceptually uniform, legible with any colour vision, and few photographs have the colours of its bright end.
COLORMAP = "inferno"
#: Opacity of attention at the top of the scale; at the bottom it is 0, and between them it grows with the value.
OPACITY = 0.8
#: Part of the picture's own colour that is kept, so that a yellow cup does not look like a bright patch.
COLOR_KEPT = 0.35
#: Outlines of groups; the scale has none of these colours: cyan, green, white, pink.
OUTLINE_COLORS = ((0, 229, 255), (118, 255, 3), (255, 255, 255), (255, 128, 171))
#: The scale ends at this quantile of all values that are shown with it: a single patch must not make the others dark.
_TOP_QUANTILE = 0.995
#: The scale ends at this many times the value of uniform attention, or above.
_LEAST_TOP = 4.0


@dataclass(frozen=True)
class Scale:
    """The scale of a set of overlays: 0 is transparent, `high` and more have the last colour.

    `uniform` is the value of uniform attention, None where it differs from replan to replan.
    """

    high: float
    label: str
    uniform: float | None = 1.0
    unit: str = ""

    def position(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Place of values (...) on the scale, 0 to 1."""
        return np.clip(np.asarray(values, dtype=np.float64) / self.high, 0.0, 1.0)

    def colors(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Colour and opacity (..., 4) of values (...), all in 0 to 1."""
        from matplotlib import colormaps

        place = self.position(values)
        rgba = np.asarray(colormaps[COLORMAP](place))
        rgba[..., 3] = OPACITY * place
        return rgba


def patch_values(
    mass: NDArray[np.floating], image_mass: NDArray[np.floating], uniform_mass: NDArray[np.floating], measure: Measure
) -> NDArray[np.float64]:
    """The values that an overlay shows, from the masses of patches.

    share: 100 x mass / summed mass of all image keys of the replan, in per cent.
    lift: mass / the mass that uniform attention gives, which has lift 1 in every patch.

    Args:
        mass: (replan, row, column).
        image_mass: (replan,), mass of all image keys of all cameras.
        uniform_mass: (replan, row, column), what uniform attention gives the patches.
        measure: lift or share.

    Returns:
        (replan, row, column); NaN where the divisor is 0.
    """
    below = np.asarray(uniform_mass) if measure == "lift" else np.asarray(image_mass)[:, None, None] / 100.0
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mass, dtype=np.float64) / below


def scale_for(values: NDArray[np.floating], measure: Measure, num_patches: int) -> Scale:
    """One scale for overlays that are compared, from 0 to the 99.5% quantile of `values`.

    It ends at 4 times the uniform value or above, so that nearly uniform attention does not look concentrated.
    `num_patches`: image keys of all cameras together, which share 100%.
    """
    uniform = 1.0 if measure == "lift" else 100.0 / num_patches
    finite = np.asarray(values)[np.isfinite(values)]
    top = float(np.quantile(finite, _TOP_QUANTILE)) if finite.size else 0.0
    high = _round_up(max(top, _LEAST_TOP * uniform))
    if measure == "lift":
        return Scale(high, "lift of a patch (mass / mass of uniform attention)", uniform)
    return Scale(high, "share of a patch in all image attention (%)", uniform, "%")


def _round_up(value: float) -> float:
    """Round up to two significant digits, for the end of a scale."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.round(np.ceil(np.round(value / step, 9)) * step, 12))


def overlay_image(
    frame: NDArray[np.uint8] | None,
    patch_map: NDArray[np.floating],
    scale: Scale,
    smooth: bool = False,
    size: tuple[int, int] | None = None,
) -> NDArray[np.uint8]:
    """Lay a patch map over its picture, both as they are stored.

    Colours are of `inferno`; opacity grows linearly from 0 at the bottom of the scale to 0.8 at its top; the picture is
    drawn with a third of its own colour. A value that is undefined (NaN) leaves the picture as it is.

    Args:
        frame: (row, column, 3) uint8; None when no picture was stored: the map alone, on grey.
        patch_map: (row, column) values of patches.
        scale: the values of the colours.
        smooth: bilinear instead of nearest; see `enlarge`.
        size: (height, width) of the result without a frame.

    Returns:
        (row, column, 3) uint8, of the frame's size.
    """
    if frame is None:
        if size is None:
            raise BadArgument("An overlay without a picture needs the size of one.")
        frame = np.full((*size, 3), NO_PICTURE, dtype=np.uint8)
    values = enlarge(patch_map, frame.shape[0], frame.shape[1], smooth)
    picture = frame.astype(np.float64)
    grey = picture @ np.array([0.299, 0.587, 0.114])
    picture = COLOR_KEPT * picture + (1.0 - COLOR_KEPT) * grey[:, :, None]
    color = scale.colors(np.nan_to_num(values))
    opacity = np.where(np.isnan(values), 0.0, color[..., 3])[:, :, None]
    mixed = (1.0 - opacity) * picture + opacity * 255.0 * color[..., :3]
    return np.asarray(np.clip(np.round(mixed), 0, 255), dtype=np.uint8)


def outline(
    image: NDArray[np.uint8], member: NDArray[np.bool_], color: tuple[int, int, int], width: int = 2
) -> NDArray[np.uint8]:
    """Draw a line of `width` pixels along the inner border of the member patches (row, column), on (row, column, 3)."""
    inside = enlarge(member.astype(np.float64), image.shape[0], image.shape[1]) > 0.5
    kept = inside.copy()
    for _ in range(width):
        padded = np.pad(kept, 1)
        kept &= padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    result = image.copy()
    result[inside & ~kept] = color
    return result


def outline_color(number: int) -> tuple[int, int, int]:
    """Red, green and blue (0..255) of the outline of the group with this number, from 0."""
    return OUTLINE_COLORS[number % len(OUTLINE_COLORS)]


def color_bar(scale: Scale, length: int = 256, thickness: int = 16) -> NDArray[np.uint8]:
    """The scale as a picture (thickness, length, 3), from 0 on the left: colours as they look on a grey picture."""
    values = np.broadcast_to((np.arange(length) + 0.5) / length * scale.high, (thickness, length))
    return overlay_image(np.full((thickness, length, 3), 128, dtype=np.uint8), values, scale)
