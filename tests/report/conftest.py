"""A browser and finished runs, each made once for all tests of this folder."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from lidarpose.model.turntable_run import TurntableRun
from lidarpose.simulate.observations import Blunders
from tests_support.browser import Browser, find_browser
from tests_support.turntable_runs import turntable_run


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    program = find_browser()
    if program is None:
        if os.environ.get("LIDARPOSE_REQUIRE_BROWSER"):
            pytest.fail("LIDARPOSE_REQUIRE_BROWSER is set, but there is no Chromium on the path")
        pytest.skip("no Chromium on the path (Debian's package is called chromium)")
    with Browser(program) as found:
        yield found


@pytest.fixture(scope="session")
def good_run() -> TurntableRun:
    """The paper's geometry: 87 places over 21.5 degrees."""
    return turntable_run()


@pytest.fixture(scope="session")
def bad_run() -> TurntableRun:
    """Few places with wrong readings, many outliers, four scans without lines, and a hostile name."""
    return turntable_run(
        places=12,
        turntable_sigma_rad=0.02,
        blunders=Blunders(stripe_share=0.2, range_share=0.1),
        name='<img src=x onerror="document.title=1"> & co',
        lost=4,
    )
