"""Robust statistics against NumPy's own."""

import numpy as np
import pytest

from lidarpose.geometry.robust import quantile


@pytest.mark.parametrize("size", [1, 2, 7, 100])
def test_quantile_is_numpys(size: int) -> None:
    values = np.random.default_rng(size).normal(size=size)
    for share in (0.0, 0.35, 0.5, 0.9, 1.0):
        assert quantile(values, share) == pytest.approx(float(np.quantile(values, share)), rel=1e-15, abs=1e-15)
