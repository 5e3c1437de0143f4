"""The boxes of the residuals' figures."""

import numpy as np

from lidarpose.report.turntable_residuals import _quantiles


def test_quantiles_are_numpys() -> None:
    rng = np.random.default_rng(0)
    shares = np.array([0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0])
    for n in (1, 2, 3, 10, 57):
        values = rng.normal(size=n)
        np.testing.assert_allclose(_quantiles(values, shares), np.quantile(values, shares), atol=1e-15)
