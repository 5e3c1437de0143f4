"""Fixtures of the whole test run."""

from pathlib import Path

import pytest

from tests_support.sessions import write_simulated_session


@pytest.fixture(scope="session")
def simulated_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small simulated turntable session. Tests that change it must copy it first."""
    return write_simulated_session(tmp_path_factory.mktemp("sessions") / "session")
