"""Real recordings, which do not belong to the repository."""

from __future__ import annotations

from pathlib import Path

import pytest

_DATA = Path(__file__).parents[2].parent / "shared/data"


def recording(name: str) -> Path:
    """The folder of a real recording; skips the test, saying so, where it is missing."""
    if not (_DATA / name).is_dir():
        pytest.skip(f"no real recording {name} in ../shared/data")
    return _DATA / name
