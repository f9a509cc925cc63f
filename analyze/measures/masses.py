"""From rows and weights to masses and what follows from them. Pure arithmetic on arrays."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.groupings.grouping import Grouping


def masses(rows: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """Mass of each group: the sum over keys of probability x weight.

    Args:
        rows: (replan, ..., key), or segment masses (replan, ..., segment).
        weights: (replan or 1, key, group), in 0..1.

    Returns:
        (replan, ..., group).
    """
    return weighted_sums(rows, weights).astype(np.float64)


def weighted_sums(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums over keys of values (replan, ..., key) x weights (replan or 1, key, group), shape (replan, ..., group).

    One product per replan, or a single one for weights that never change; float32 sums err by about 3e-7.
    """
    flat = values.reshape(values.shape[0], -1, values.shape[-1])
    product = flat.reshape(-1, flat.shape[-1]) @ weights[0] if len(weights) == 1 else np.matmul(flat, weights)
    sums: NDArray[np.float32] = product.reshape(*values.shape[:-1], weights.shape[2])
    return sums


@dataclass(frozen=True)
class GroupMeasures:
    """The measures of every group, each of shape (replan, ..., group).

    A field is a column of every table of groups; over replans, episodes and tasks its finite values are averaged.
    """

    mass: NDArray[np.float64]
    fraction: NDArray[np.float64]
    keys: NDArray[np.float64]
    density: NDArray[np.float64]
    lift: NDArray[np.float64]

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """The measures by the names of their columns."""
        return {name: getattr(self, name) for name in GROUP_MEASURES}


#: The columns of groups, in the order of the tables.
GROUP_MEASURES = tuple(field.name for field in fields(GroupMeasures))


def group_measures(
    mass: NDArray[np.float64],
    valid_mass: NDArray[np.float64],
    num_keys: NDArray[np.float64],
    uniform_mass: NDArray[np.float64],
    uniform_valid: NDArray[np.float64],
) -> GroupMeasures:
    """Fractions, densities and lifts of masses.

    fraction = mass / sum of the masses of all groups; density = mass / number of keys;
    lift = (mass / the mass that uniform attention gives) / (the same of all valid keys), so that attention that is
    uniform at each query gives 1 (`schemas/groupings/key_counts.py`). Keys of a null sink (Cosmos's padded text) are
    not valid: their mass is not in the mass of all valid keys.

    Args:
        mass: (replan, ..., group).
        valid_mass: (replan, ...), sum over all valid keys.
        num_keys: (replan or 1, group), fractional where objects cover parts of patches.
        uniform_mass: what uniform attention gives the groups; as `mass`, or with axes of length 1.
        uniform_valid: what it gives all valid keys; as `valid_mass`, or with axes of length 1.

    Returns:
        Measures; density of a group without keys, lift of a group of which no query sees a key, and every fraction of a
        row without any mass, is NaN.
    """
    keys = num_keys.reshape(num_keys.shape[0], *(1,) * (mass.ndim - 2), num_keys.shape[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = mass / mass.sum(axis=-1, keepdims=True)
        density = np.where(keys > 0, mass / keys, np.nan)
        lift = np.where(uniform_mass > 0, mass / uniform_mass, np.nan) / (valid_mass / uniform_valid)[..., None]
    return GroupMeasures(mass, fraction, keys, density, lift)


def ratio(numerator: NDArray[np.float64], denominator: NDArray[np.float64]) -> NDArray[np.float64]:
    """numerator / denominator: infinite where only the denominator is 0, NaN (undefined) where both are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / denominator


def sides(values: NDArray[np.float64], grouping: Grouping) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of values (..., group) over the groups of the ratio's numerator and of its denominator, (...) each."""
    assert grouping.ratio is not None
    top, bottom = (
        [grouping.names.index(name) for name in side] for side in (grouping.ratio.numerator, grouping.ratio.denominator)
    )
    return values[..., top].sum(axis=-1), values[..., bottom].sum(axis=-1)


def uniform_ratio(uniform_mass: NDArray[np.float64], grouping: Grouping) -> NDArray[np.float64]:
    """The ratio that uniform attention gives (...), from what it gives the groups (..., group), see `group_measures`.

    Infinite or NaN as in `ratio`.
    """
    return ratio(*sides(uniform_mass, grouping))


def finite_mean(values: NDArray[np.float64], axis: int | tuple[int, ...] = 0) -> NDArray[np.float64]:
    """Mean over the finite values along one axis or several; NaN where there is none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    with np.errstate(invalid="ignore"):
        mean: NDArray[np.float64] = np.where(finite, values, 0.0).sum(axis=axis) / np.where(count > 0, count, np.nan)
    return mean
