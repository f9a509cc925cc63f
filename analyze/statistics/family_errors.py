"""The error of a mean over tasks whose families are related: cluster-robust, for few families. Pure functions.

The estimate is the mean over tasks, and every task weighs the same; only its error is by families. With T tasks,
deviations e_t from the mean and families g of n_g tasks,

    variance = sum over g of (sum of the e_t in g)^2 / (T (T - n_g)).

This is the bias-reduced linearisation of a mean ("CR2": Bell & McCaffrey 2002, "Bias reduction in standard errors for
linear regression with multi-stage samples", Survey Methodology 28): residuals of a family are multiplied by
(I - H_gg)^(-1/2), which for a mean is 1 / sqrt(1 - n_g / T) of their sum. It is unbiased where tasks are independent
and spread alike. The degrees of freedom are Satterthwaite's under the same working model: with p_gh the matrix of the
quadratic form, (sum p_gg)^2 / sum p_gh^2 (Bell & McCaffrey 2002; Pustejovsky & Tipton 2018, "Small-sample methods for
cluster-robust variance estimation and hypothesis testing in fixed effects models", Journal of Business & Economic
Statistics 36). They depend on the sizes of the families alone, and are few where one family has most of the tasks.

With families of one task each, this is s^2 / T with T - 1 degrees of freedom; with G families of equal size, the t
interval over the means of families with G - 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Degrees of freedom this close to a whole number are that number.
_ROUNDING = 1e-9


def family_shares(
    deviations: NDArray[np.float64], there: NDArray[np.bool_], families: NDArray[np.intp], fewest: int = 2
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What each family adds to the error of a mean over tasks: its square is a part of the variance.

    Args:
        deviations: from the mean, (..., task).
        there: which tasks the mean is over, (..., task).
        families: number of each task's family, (task,).
        fewest: with fewer families in the mean there is no error.

    Returns:
        Shares (..., family), 0 where a family has no task in the mean, and the degrees of freedom (...); NaN where
        there is no error.
    """
    member = (families[:, None] == np.arange(families.max(initial=-1) + 1)).astype(np.float64)  # (task, family)
    sums, size = np.where(there, deviations, 0.0) @ member, there.astype(np.float64) @ member
    total = size.sum(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(size > 0, sums / np.sqrt(total * (total - size)), 0.0)
        # p_gg = n_g / T^2 and p_gh^2 = a_g a_h / T^2, with a_g = n_g^2 / (T (T - n_g)).
        a = size**2 / (total * (total - size))
        off_diagonal = a.sum(axis=-1) ** 2 - (a**2).sum(axis=-1)
        degrees = 1.0 / ((size**2).sum(axis=-1) / total[..., 0] ** 2 + off_diagonal)
    enough = (size > 0).sum(axis=-1) >= max(fewest, 2)
    whole = np.round(degrees)
    degrees = np.where(np.abs(degrees - whole) < _ROUNDING, whole, degrees)
    return np.where(enough[..., None], shares, np.nan), np.where(enough, degrees, np.nan)


def family_error(
    deviations: NDArray[np.float64], there: NDArray[np.bool_], families: NDArray[np.intp], fewest: int = 2
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variance of a mean over tasks and its degrees of freedom, (...) each; the arguments are those of
    `family_shares`.
    """
    shares, degrees = family_shares(deviations, there, families, fewest)
    variance: NDArray[np.float64] = (shares**2).sum(axis=-1)
    return variance, degrees
