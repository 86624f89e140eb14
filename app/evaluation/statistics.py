"""Means over frames and their confidence intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over frames and its bootstrap interval."""

    mean: float
    low: float
    high: float
    frames: int


def bootstrap_mean(values: NDArray[np.float64], *, draws: int = 2000) -> Estimate:
    """Compute a mean over frames and its 95 % percentile bootstrap interval.

    Parameters
    ----------
    values : (N,) float64
        One value per frame; NaN is left out.
    draws : int
        Number of resamples.

    Returns
    -------
    Estimate
        NaN if there is no value.

    References
    ----------
    .. [1] B. Efron, R. Tibshirani, "An introduction to the bootstrap", 1993, chapter 13.
    """
    values = values[np.isfinite(values)]
    if values.size == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), 0)
    mean = float(values.mean())
    if values.size == 1:
        return Estimate(mean, mean, mean, 1)
    low, high = bootstrap(
        (values,),
        np.mean,
        n_resamples=draws,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(mean, float(low), float(high), values.size)
