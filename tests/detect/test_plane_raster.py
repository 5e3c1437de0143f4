"""Pieces of rasters against SciPy's."""

import numpy as np
import pytest
from scipy import ndimage

from lidarpose.detect.plane_raster import FEW_CELLS, largest_piece


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (6, 6), (17, 22), (60, 40)])
def test_the_largest_piece_is_the_one_that_labels_give(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    assert (shape[0] * shape[1] > FEW_CELLS) == (shape == (60, 40))
    for density in (0.05, 0.2, 0.4, 0.8, 3.0):
        counts = rng.poisson(density, shape)
        counts[rng.integers(shape[0]), rng.integers(shape[1])] += 1
        labels, pieces = ndimage.label(counts > 0, structure=np.ones((3, 3)))
        held = [int(counts[labels == k].sum()) for k in range(1, pieces + 1)]
        np.testing.assert_array_equal(largest_piece(counts), labels == 1 + int(np.argmax(held)))


def test_of_pieces_alike_the_first_counts_and_of_nothing_nothing() -> None:
    counts = np.array([[0, 0, 2, 0], [0, 0, 0, 0], [1, 1, 0, 2]])
    assert np.flatnonzero(largest_piece(counts)).tolist() == [2]
    assert not largest_piece(np.zeros((3, 4), dtype=np.int64)).any()
