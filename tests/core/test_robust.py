from __future__ import annotations

import numpy as np

from core.robust import biweight, finite_median, robust_sigma


def test_medians_pass_over_what_is_not_there() -> None:
    values = np.array([[3.0, np.nan, 1.0, 2.0], [np.inf, 4.0, np.nan, 8.0], [np.nan] * 4])
    assert finite_median(values).tolist() == [2.0, 6.0, 0.0]


def test_a_third_of_outliers_hardly_widens_the_spread() -> None:
    residual = np.random.default_rng(2).normal(scale=3e-4, size=(4, 3000))
    residual[:, ::10] = np.nan
    np.testing.assert_allclose(robust_sigma(residual), 3e-4, rtol=0.05)
    residual[:, ::3] = 1.0
    assert (robust_sigma(residual) < 6e-4).all()


def test_biweight_falls_from_one_to_nothing() -> None:
    weights = biweight(np.array([0.0, 1.0, 4.0, 4.7, -9.0, np.nan]), 1.0)
    assert weights[0] == 1.0
    assert 0.9 < weights[1] < 1.0
    assert 0.0 < weights[2] < 0.1
    assert weights[3:].tolist() == [0.0, 0.0, 0.0]
