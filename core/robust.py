"""Medians, spreads and weights that outliers do not move."""

from __future__ import annotations

import numpy as np

from core.coordinates import Floats

# Tukey's biweight at 95 % efficiency under normal noise (Holland & Welsch 1977).
TUKEY = 4.685
# Standard deviation of a normal variable, in units of the median of its magnitude.
BY_MEDIAN = 1.4826


def finite_median(values: Floats) -> Floats:
    """Return the median of what is finite along the last axis; 0 where nothing is. Quicker than numpy's own."""
    size = values.shape[-1]
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf), axis=-1).reshape(-1, size)
    count = np.isfinite(ordered).sum(axis=-1)
    row = np.arange(len(ordered))
    middle = 0.5 * (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, np.minimum(count // 2, size - 1)])
    return np.where(count > 0, middle, 0.0).reshape(values.shape[:-1])


def robust_sigma(residual: Floats) -> Floats:
    """Return the standard deviation of residuals about zero along the last axis, from the median of what is finite."""
    return np.asarray(BY_MEDIAN * finite_median(np.abs(residual)))


def biweight(residual: Floats, sigma: Floats | float) -> Floats:
    """Return Tukey's weights of residuals with a given standard deviation; nan residuals weigh nothing."""
    ratio = np.nan_to_num((residual / (TUKEY * np.asarray(sigma))) ** 2, nan=1.0)
    return np.asarray(np.where(ratio < 1.0, (1.0 - np.minimum(ratio, 1.0)) ** 2, 0.0))
