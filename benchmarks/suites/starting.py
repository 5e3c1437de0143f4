"""How long the package and the command take to start, warm and cold."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.report import Effort, Report, Table
from benchmarks.timing import interleaved, pace

PROGRAMS: dict[str, list[str]] = {
    "the interpreter alone": ["-c", "pass"],
    "import lidarpose": ["-c", "import lidarpose"],
    "import numpy": ["-c", "import numpy"],
    "lidarpose --help": ["-m", "lidarpose", "--help"],
    "lidarpose calibrate --help": ["-m", "lidarpose", "calibrate", "--help"],
    "import lidarpose.workflows.turntable": ["-c", "import lidarpose.workflows.turntable"],
    "import open3d": ["-c", "import open3d"],
}


def run(effort: Effort) -> Report:
    installed = {name: p for name, p in PROGRAMS.items() if name != "import open3d" or _has_open3d()}
    pace()
    programs: dict[str, Callable[[], object]] = {name: _program(p) for name, p in installed.items()}
    warm = interleaved({**programs, "pace": pace}, effort.pick(15, 3), budget_s=5.0)
    with tempfile.TemporaryDirectory() as folder:
        ways = {name: _cold(p, Path(folder)) for name, p in installed.items() if "open3d" not in name}
        # Every run finds another empty folder for byte code, so none of them is warm.
        cold = interleaved(ways, effort.pick(5, 2), budget_s=8.0)
    figures = {
        "start.import_s": warm["import lidarpose"],
        "start.help_s": warm["lidarpose --help"],
        "start.import_cold_s": cold["import lidarpose"],
        "start.help_cold_s": cold["lidarpose --help"],
    }
    rows = [[name, _round(warm.get(name)), _round(cold.get(name), "-")] for name in PROGRAMS]
    return Report(figures, [Table("Starting", ["process", "warm, s", "cold, s"], rows, _TEXT)], pace_s=warm["pace"])


_TEXT = (
    "Whole processes. Cold: no compiled byte code, and the files that the process reads dropped from the page cache "
    "(as far as no other process holds them)."
)


def _has_open3d() -> bool:
    from importlib.util import find_spec

    return find_spec("open3d") is not None


def _round(value: float | None, missing: str | None = None) -> str | None:
    return missing if value is None else f"{value:.3f}"


def _program(arguments: Sequence[str], **extra: str) -> Callable[[], object]:
    environment = {**os.environ, **extra}
    return lambda: subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, env=environment)


def _cold(arguments: Sequence[str], folder: Path) -> Callable[[], object]:
    files = _files_read(arguments)

    def start() -> None:
        for path in files:
            _forget(path)
        with tempfile.TemporaryDirectory(dir=folder) as empty:
            _program(arguments, PYTHONPYCACHEPREFIX=empty)()

    return start


_LIST_FILES = """
import sys, runpy
from pathlib import Path
arguments = sys.argv[1:]
sys.stdout = open("/dev/null", "w")
try:
    if arguments[0] == "-c":
        exec(arguments[1])
    else:
        sys.argv = arguments[1:]
        runpy.run_module(arguments[1], run_name="__main__")
except SystemExit:
    pass
found = {getattr(m, "__file__", None) for m in list(sys.modules.values())}
found |= {line.split(maxsplit=5)[5].strip() for line in open("/proc/self/maps") if "/" in line}
print("\\n".join(sorted(f for f in found if f)), file=sys.stderr)
"""


def _files_read(arguments: Sequence[str]) -> list[Path]:
    command = [sys.executable, "-c", _LIST_FILES, *arguments]
    done = subprocess.run(command, check=True, stderr=subprocess.PIPE, text=True)
    return [path for path in map(Path, done.stderr.splitlines()) if path.is_file()]


def _forget(path: Path) -> None:
    """Drop a file's pages from the cache, where the system lets us."""
    try:
        file = os.open(path, os.O_RDONLY)
    except OSError:
        return
    try:
        os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)
    finally:
        os.close(file)
