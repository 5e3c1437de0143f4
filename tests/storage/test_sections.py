"""Documents read without pydantic: what it accepts is accepted, with the same values, and nothing else."""

import subprocess
import sys
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from lidarpose.errors import InputError
from lidarpose.storage import corner_session, recording, sections, session

TURNTABLE: dict[str, Any] = {
    "format": "lidarpose/turntable-session@1",
    "camera": "camera.yaml",
    "positions": "positions.csv",
    "board": {"images": "b/*.png", "panels": [{"columns": 20, "rows": 14, "square_m": 0.02}] * 2},
    "lidar": {"model": "LMS", "range_sigma_m": 1e-3},
    "turning": {"beams": "clockwise-from-above"},
}
CORNERS: dict[str, Any] = {
    "format": "lidarpose/corner-session@1",
    "positions": "positions.csv",
    "world_sigma_m": 0.001,
    "estimate_scale": True,
    "cloud_frame": "camera",
    "lidar": {"beam_crossing_m": 0.04},
}
RECORDING: dict[str, Any] = {"format": "lidarpose/sweep-recording@1", "lidar": {"range_sigma_m": 0}}
KINDS: list[tuple[Any, dict[str, Any]]] = [
    (session._SessionFile, TURNTABLE),
    (corner_session._SessionFile, CORNERS),
    (recording._HeadFile, RECORDING),
]
VALUES: list[Any] = [
    None,
    True,
    0,
    1,
    3,
    -1,
    500,
    10**400,
    0.0,
    0.5,
    2.0,
    float("nan"),
    float("inf"),
    "",
    "x",
    "1",
    "lidar",
]
VALUES += [[], [1], {}, {"model": "x"}, "clockwise-from-right", [{"columns": 4, "rows": 4, "square_m": 1}] * 3, b"x"]


def changed(document: Any, rng: np.random.Generator) -> Any:
    """A document with a value, key or element changed somewhere."""
    out = deepcopy(document)
    at = out
    while True:
        key = rng.choice(list(at)) if isinstance(at, dict) and at else None
        if isinstance(at, list) and at:
            key = int(rng.integers(len(at)))
        if key is None:
            return out
        if isinstance(at[key], dict | list) and rng.random() < 0.7:
            at = at[key]
            continue
        action = rng.integers(4)
        if action == 0:
            del at[key]
        elif action == 1 and isinstance(at, dict):
            at["other"] = at[key]
        else:
            at[key] = VALUES[rng.integers(len(VALUES))]
        return out


@pytest.mark.parametrize(("kind", "document"), KINDS)
def test_what_pydantic_accepts_is_accepted_and_nothing_else(kind: Any, document: dict[str, Any]) -> None:
    schema = sections._schema(kind)
    rng = np.random.default_rng(0)
    accepted = 0
    for _ in range(1500):
        tried = changed(document, rng)
        if rng.random() < 0.3:
            tried = changed(tried, rng)
        found = sections.plainly(kind, tried)
        try:
            expected = schema.model_validate(tried)
        except ValidationError:
            assert found is None, tried
            with pytest.raises(InputError):
                sections.read_sections(Path("session.toml"), kind, tried)
            continue
        assert found is not None, tried
        for name, value in expected.model_dump(exclude_unset=True).items():
            assert_same(getattr(found, name), value)
        accepted += 1
    assert accepted > 100


def assert_same(found: Any, expected: Any) -> None:
    """Sections equal what pydantic makes of them, kinds of numbers included."""
    if isinstance(expected, dict):
        for name, value in expected.items():
            assert_same(getattr(found, name), value)
    elif isinstance(expected, list):
        for a, b in zip(found, expected, strict=True):
            assert_same(a, b)
    else:
        assert found == expected
        assert type(found) is type(expected)


def test_a_session_is_read_without_pydantic() -> None:
    code = f"""
import sys
import lidarpose.storage.calibration, lidarpose.workflows.turntable
from lidarpose.storage.sections import plainly
from lidarpose.storage.session import _SessionFile

assert plainly(_SessionFile, {TURNTABLE!r})
assert "pydantic" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
