"""From rows and weights to masses and what follows from them. Pure arithmetic on arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def masses(rows: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """Mass of each group: the sum over keys of probability x weight.

    Args:
        rows: (replan, ..., key), or segment masses (replan, ..., segment).
        weights: (replan or 1, key, group), in 0..1.

    Returns:
        (replan, ..., group).
    """
    replans, groups = rows.shape[0], weights.shape[2]
    flat = rows.reshape(replans, -1, rows.shape[-1])
    # One product per replan (or a single one for weights that never change); float32 sums err by about 3e-7.
    product = flat.reshape(-1, rows.shape[-1]) @ weights[0] if len(weights) == 1 else np.matmul(flat, weights)
    return product.reshape(*rows.shape[:-1], groups).astype(np.float64)


@dataclass(frozen=True)
class GroupMeasures:
    """What is said about every group, each of shape (replan, ..., group)."""

    mass: NDArray[np.float64]
    fraction: NDArray[np.float64]
    density: NDArray[np.float64]
    lift: NDArray[np.float64]


def group_measures(
    mass: NDArray[np.float64],
    valid_mass: NDArray[np.float64],
    num_keys: NDArray[np.float64],
    num_valid: NDArray[np.int64],
) -> GroupMeasures:
    """Fractions, densities and lifts of masses.

    fraction = mass / sum of the masses of all groups; density = mass / number of keys;
    lift = density / (mass of all valid keys / their number), so that attention that is uniform over the valid keys gives 1. Keys of
    a null sink (Cosmos's padded text) are not valid, and what they take is no part of the comparison.

    Args:
        mass: (replan, ..., group).
        valid_mass: (replan, ...), sum over all valid keys.
        num_keys: (replan or 1, group), fractional where objects cover parts of patches.
        num_valid: (replan or 1,).

    Returns:
        Measures; density and lift of a group without keys, and every fraction of a row without any mass, is NaN.
    """
    middle = (1,) * (mass.ndim - 2)
    keys = num_keys.reshape(num_keys.shape[0], *middle, num_keys.shape[1])
    valid = num_valid.reshape(num_valid.shape[0], *middle, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = mass / mass.sum(axis=-1, keepdims=True)
        density = np.where(keys > 0, mass / keys, np.nan)
        lift = density / (valid_mass[..., None] / valid)
    return GroupMeasures(mass, fraction, density, lift)


def ratio(numerator: NDArray[np.float64], denominator: NDArray[np.float64]) -> NDArray[np.float64]:
    """numerator / denominator: infinite where only the denominator is 0, NaN (undefined) where both are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / denominator


def finite_mean(values: NDArray[np.float64], axis: int | tuple[int, ...] = 0) -> NDArray[np.float64]:
    """Mean over the finite values along one axis or several; NaN where there is none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=axis)
    with np.errstate(invalid="ignore"):
        mean: NDArray[np.float64] = np.where(finite, values, 0.0).sum(axis=axis) / np.where(count > 0, count, np.nan)
    return mean
