"""Settings of the comparison of attention maps with object masks."""

from __future__ import annotations

from dataclasses import dataclass

from vla_attention.schemas.errors import BadArgument


@dataclass(frozen=True)
class ObjectSettings:
    """How attention maps are compared with objects.

    Attributes:
        percentiles: thresholds of the attended region, beside Otsu's.
        mask_coverage: a patch belongs to an object when the object covers at least this share of it.
        tolerance: of the pointing game, in patch widths: how far beside the object the maximum may lie. One patch of 14
            pixels is about the 15 pixels of Zhang et al. 2018.
        spatial: whether centres, pointing game and IoU are computed (they take most of the time).
    """

    percentiles: tuple[float, ...] = (80.0, 90.0, 95.0)
    mask_coverage: float = 0.5
    tolerance: float = 1.0
    spatial: bool = True

    def __post_init__(self) -> None:
        """Check the ranges."""
        for percentile in self.percentiles:
            if not 0.0 < percentile < 100.0:
                raise BadArgument(f"Percentile {percentile:g} was given; expected a number above 0 and below 100.")
        if len(set(self.percentiles)) != len(self.percentiles):
            raise BadArgument("A percentile was given twice.")
        if not 0.0 < self.mask_coverage <= 1.0:
            raise BadArgument(f"Mask coverage {self.mask_coverage:g} was given; expected a share above 0, at most 1.")
        if self.tolerance < 0.0:
            raise BadArgument(f"Tolerance {self.tolerance:g} was given; expected 0 or more patch widths.")

    @property
    def thresholds(self) -> tuple[str, ...]:
        """Names of the thresholds in tables: p80, p90, p95 and otsu."""
        return (*(f"p{percentile:g}" for percentile in self.percentiles), "otsu")

    @property
    def shown_threshold(self) -> str:
        """The threshold that texts and pictures show: the second one, where there are two."""
        return self.thresholds[min(1, len(self.thresholds) - 1)]
