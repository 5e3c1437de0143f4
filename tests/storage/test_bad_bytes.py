"""Every reader, fed with damaged and random bytes: data or one InputError. `tests_support.bad_bytes` tries more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests_support.bad_bytes import READERS, Reader, damage, mend_e57, try_reading

_QUIET = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
@pytest.mark.filterwarnings("ignore")
def test_the_seed_is_whole(reader: Reader, tmp_path: Path) -> None:
    path, target = reader.make(tmp_path)
    found = reader.read(target)
    assert not (isinstance(found, int) and found == 2)  # of a command: that its input cannot be read
    if path.suffix == ".e57":
        assert mend_e57(path.read_bytes()) == path.read_bytes()


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
@pytest.mark.filterwarnings("ignore")
def test_damaged_bytes(reader: Reader, tmp_path: Path) -> None:
    path, target = reader.make(tmp_path)
    whole = path.read_bytes()

    @settings(max_examples=12, deadline=None, database=None, derandomize=True, suppress_health_check=_QUIET)
    @given(st.integers(0, 2**32 - 1))
    def attempt(seed: int) -> None:
        try_reading(reader, path, target, damage(whole, np.random.default_rng(seed)))

    attempt()


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
@pytest.mark.filterwarnings("ignore")
def test_random_bytes(reader: Reader, tmp_path: Path) -> None:
    path, target = reader.make(tmp_path)

    @settings(max_examples=8, deadline=None, database=None, derandomize=True, suppress_health_check=_QUIET)
    @given(st.binary(max_size=400))
    def attempt(data: bytes) -> None:
        try_reading(reader, path, target, data)

    attempt()
