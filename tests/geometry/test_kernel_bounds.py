"""No kernel reads or writes beyond its arrays: numba checks that only where it is asked to."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidarpose.geometry import compiled

TESTS = Path(__file__).parents[1]
KERNEL_TESTS = (
    "detect/test_scan_line_kernels.py",
    "detect/test_stripe_kernels.py",
    "detect/test_target_kernels.py",
    "detect/test_plane_kernels.py",
    "measure/test_assemble.py",
    "refine/test_corner_kernels.py",
)


@pytest.mark.slow
@pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")
def test_kernels_stay_within_their_arrays(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    files = [str(TESTS / name) for name in KERNEL_TESTS]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout[-4000:]
