"""Work shared by threads."""

import threading
from queue import Empty

import numpy as np
import pytest

from lidarpose.geometry import threads


@pytest.mark.parametrize("elements", [10, 100_000])
def test_results_come_in_order_and_errors_come_through(elements: int) -> None:
    assert threads.each(lambda k: k * k, range(7), elements) == [k * k for k in range(7)]
    assert threads.each(lambda k: k, [], elements) == []
    with pytest.raises(ZeroDivisionError):
        threads.each(lambda k: 1 // (3 - k), range(7), elements)


@pytest.mark.parametrize("first", [ValueError, Empty])
def test_of_several_errors_the_first_items_comes_through(monkeypatch: pytest.MonkeyPatch, first: type) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    later = threading.Event()

    def fail(k: int) -> None:
        if k == 0:
            later.wait(10.0)
            raise first
        later.set()
        raise KeyError(k)

    with pytest.raises(first):
        threads.each(fail, range(4), threads.LARGE)


def test_small_work_stays_in_its_thread() -> None:
    assert set(threads.each(lambda _: threading.get_ident(), range(5), 10)) == {threading.get_ident()}


def test_blas_has_its_threads_back_after_the_block_even_if_it_fails() -> None:
    counters = threads._openblas()
    if counters is None:
        pytest.skip("NumPy stands on another library than OpenBLAS")
    get, put = counters
    before = get()
    try:
        put(2)
        with threads.one_blas_thread():
            assert get() == 1
            np.testing.assert_allclose(np.ones((300, 300)) @ np.ones((300, 300)), 300.0)
        assert get() == 2
        with pytest.raises(ValueError, match="inside"), threads.one_blas_thread():
            raise ValueError("inside")
        assert get() == 2
    finally:
        put(before)
