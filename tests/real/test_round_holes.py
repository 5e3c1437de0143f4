"""Four round holes in a board, seen by a 64-ring LiDAR: their centres are 0.60 m apart."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from lidarpose.storage.clouds import read_cloud
from lidarpose.workflows.measuring import measure_disk, view_of_cloud

FOLDER = Path(__file__).parents[2] / ".." / "shared" / "data" / "roundhole_opencalib"


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"real recordings are missing: {FOLDER}")
@pytest.mark.parametrize("name", ["2022-01-18-15-25-03-449.pcd", "2022-01-18-15-25-03-949.pcd"])
def test_neighbouring_holes_are_0_60_m_apart(name: str) -> None:
    found = measure_disk(view_of_cloud(read_cloud(FOLDER / name), None), "hole")
    centres = np.array([m.centre for m in found])
    # The board stands before the LiDAR, its normal along x.
    on_board = centres[[abs(m.normal[0]) > 0.9 for m in found]]
    assert len(on_board) == 4
    distances = sorted(float(np.linalg.norm(a - b)) for a, b in combinations(on_board, 2))
    assert all(abs(d - 0.60) < 0.015 for d in distances[:4])
    assert all(abs(d - 0.60 * np.sqrt(2.0)) < 0.02 for d in distances[4:])
