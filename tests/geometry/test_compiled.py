"""When kernels pay, and that they work where nothing can be stored."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lidarpose.geometry import compiled

SOME, OTHERS = "detect.some_kernels", "measure.kernels"


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """As if this process had asked nothing yet and numba were not imported."""
    monkeypatch.setattr(compiled, "_ledger", compiled._Ledger())
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    monkeypatch.setattr(compiled, "_stored", lambda kernels: True)
    return monkeypatch


def pretend(monkeypatch: pytest.MonkeyPatch, importable: bool) -> list[int]:
    """Count imports of numba instead of making them."""
    asked: list[int] = []

    def importing() -> bool:
        asked.append(1)
        return importable

    monkeypatch.setattr(compiled, "_importable", importing)
    return asked


def test_work_that_saves_more_than_the_import_takes_kernels_at_once(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    assert compiled.pays(1.01 * compiled.LOADING_S, SOME)


def test_small_work_takes_kernels_once_it_has_lost_as_much_as_the_import(fresh: pytest.MonkeyPatch) -> None:
    asked = pretend(fresh, True)
    answers = [compiled.pays(0.11 * compiled.LOADING_S, SOME) for _ in range(12)]
    assert answers == [False] * 9 + [True] * 3
    assert len(asked) == 1


def test_numba_that_is_imported_already_is_used(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    fresh.setitem(sys.modules, "numba", object())
    assert compiled.pays(1e-6, SOME)


def test_numba_that_cannot_be_imported_is_asked_once_and_never_used(fresh: pytest.MonkeyPatch) -> None:
    asked = pretend(fresh, False)
    assert not any(compiled.pays(10.0, SOME) for _ in range(5))
    assert len(asked) == 1


def test_where_nothing_is_stored_kernels_have_to_be_worth_compiling(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    fresh.setattr(compiled, "_stored", lambda kernels: False)
    assert not compiled.pays(0.9 * compiled.COMPILING_S, SOME)
    assert compiled.pays(0.2 * compiled.COMPILING_S, SOME)


def test_kernels_that_are_not_stored_are_not_compiled_because_others_are(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    fresh.setattr(compiled, "_stored", lambda kernels: kernels == SOME)
    assert compiled.pays(1.01 * compiled.LOADING_S, SOME)
    fresh.setitem(sys.modules, "numba", object())
    assert not compiled.pays(0.9 * compiled.COMPILING_S, OTHERS)
    assert compiled.pays(0.1 * compiled.LOADING_S, SOME)
    assert compiled.pays(0.2 * compiled.COMPILING_S, OTHERS)
    assert compiled.pays(0.0, OTHERS)


def test_all_kernels_that_are_stored_pay_for_the_import_together(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    assert not compiled.pays(0.6 * compiled.LOADING_S, SOME)
    assert compiled.pays(0.6 * compiled.LOADING_S, OTHERS)
    assert compiled.pays(0.0, SOME)


def test_a_way_that_is_forced_is_taken_and_leaves_no_trace(fresh: pytest.MonkeyPatch) -> None:
    pretend(fresh, True)
    with compiled.forced(False):
        assert not compiled.pays(100.0, SOME)
    with compiled.forced(True):
        assert compiled.pays(0.0, SOME)
    assert not compiled.pays(0.5 * compiled.LOADING_S, SOME)


@pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")
def test_kernels_compile_in_memory_where_there_is_no_folder_for_them() -> None:
    code = """
import sys
from numba.core import caching
for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator, caching.UserProvidedCacheLocator):
    locator.from_function = classmethod(lambda cls, function, path: None)
from lidarpose.geometry.compiled import kernel

@kernel
def twice(x):
    return 2.0 * x

print(twice(3.0), twice.stats.cache_path)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["6.0", "None"]
    assert done.stderr == ""


@pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")
def test_stored_kernels_are_found_where_numba_puts_them(tmp_path: Path) -> None:
    code = """
import os
from pathlib import Path
from lidarpose.geometry import compiled
print(compiled._stored("measure.kernels"))
from lidarpose.measure import kernels
import numpy as np
one = np.ones(1)
kernels._per_sweep(np.ones((1, 1)), np.ones((1, 3, 2)), np.ones((1, 3)), one, one, np.ones((1, 3)))
print(compiled._stored("measure.kernels"), compiled._stored("detect.plane_kernels"))
for index in Path(os.environ["NUMBA_CACHE_DIR"]).glob("*/*.nbi"):
    os.utime(index, (0, 0))  # older than their source
print(compiled._stored("measure.kernels"))
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["False", "True", "False", "False"]


@pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")
def test_stored_kernels_are_compiled_again_where_one_of_another_module_that_they_call_has_changed(
    tmp_path: Path,
) -> None:
    head = "from lidarpose.geometry.compiled import kernel\n"
    (tmp_path / "first_kernels.py").write_text(f"{head}@kernel\ndef factor():\n    return 2.0\n")
    (tmp_path / "second_kernels.py").write_text(
        f"{head}from first_kernels import factor\n@kernel\ndef times(x):\n    return factor() * x\n"
    )
    code = "from second_kernels import times\nprint(times(3.0), sum(times.stats.cache_hits.values()))"
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "stored"), "PYTHONPATH": path}

    def run() -> list[str]:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        return done.stdout.split()

    assert run() == ["6.0", "0"]
    assert run() == ["6.0", "1"]
    (tmp_path / "first_kernels.py").write_text(f"{head}@kernel\ndef factor():\n    return 25.0\n")
    assert run() == ["75.0", "0"]


def test_a_user_without_a_home_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError))
    assert [folder.name for folder in compiled._stores("detect")] == ["__pycache__"]


def test_asking_for_little_imports_nothing() -> None:
    code = """
import sys
from lidarpose.geometry.compiled import pays
pays(1e-3, "detect.plane_kernels")
print("numba" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
