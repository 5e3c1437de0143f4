"""Coverage-guided damage for the readers, of bounded time, by atheris, which `make fuzz` puts into a folder of its own.

From the folder ``tests``::

    python -m tests_support.atheris_job "cloud.pcd" -max_total_time=60    # one reader, libFuzzer's options
    python -m tests_support.atheris_job --seconds 100 [--write PAGE]      # all of them, so long in all

An exception that is not one `InputError`, and a file that takes longer than 2 s of processor time or 1 GB with the
libraries, ends a reader's job and leaves the bytes in a file, as libFuzzer does. `--seed` gives the same damage again;
0 draws another each time.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

_SECONDS = 2.0
_OPTIONS = ("-timeout=60", "-rss_limit_mb=1024", "-verbosity=1", "-print_final_stats=1")


def fuzz_one(name: str, options: list[str]) -> None:
    """Damage for one reader until libFuzzer's options say that it is enough; ends the process."""
    import atheris

    with atheris.instrument_imports(include=["lidarpose", "rosbags", "laspy"]):
        from tests_support.bad_bytes import READERS, try_reading

    reader = next(reader for reader in READERS if reader.name == name)
    with tempfile.TemporaryDirectory() as folder:
        path, target = reader.make(Path(folder))
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        (corpus / "seed").write_bytes(path.read_bytes())

        def attempt(data: bytes) -> None:
            start = time.process_time()  # a busy machine is no fault of the reader
            try_reading(reader, path, target, data)
            took = time.process_time() - start
            if took > _SECONDS:
                raise AssertionError(f"took {took:.1f} s of processor time")

        atheris.Setup([sys.argv[0], *_OPTIONS, *options, os.fspath(corpus)], attempt)
        atheris.Fuzz()


def _start(name: str, seconds: int, seed: int, left: Path) -> tuple[int, Path]:
    """A reader's job in a child: its process, and where its output goes."""
    stem = left / ("fuzz-" + re.sub("[^a-z0-9]+", "-", name))
    log = stem.with_suffix(".log")
    process = os.fork()
    if process == 0:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        try:
            fuzz_one(name, [f"-max_total_time={seconds}", f"-seed={seed}", f"-artifact_prefix={stem}-"])
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)  # a child that comes back here must not go on with its parent's work
    return process, log


def fuzz_all(seconds: float, seed: int, page: Path | None) -> int:
    """All readers, two at a time, and a line for each."""
    left = Path(tempfile.mkdtemp())  # not a TemporaryDirectory: a child's exit would remove it under the others
    try:
        return _fuzz_all(seconds, seed, page, left)
    finally:
        shutil.rmtree(left)


def _fuzz_all(seconds: float, seed: int, page: Path | None, left: Path) -> int:
    import atheris

    with atheris.instrument_imports(include=["lidarpose", "rosbags", "laspy"]):
        from tests_support.bad_bytes import READERS, write_figures

    each = max(1, round(2.0 * seconds / len(READERS)))
    waiting = [reader.name for reader in READERS]
    running: dict[Any, Any] = {}
    total = bad = 0
    while waiting or running:
        while waiting and len(running) < 2:
            name = waiting.pop(0)
            process, log = _start(name, each, seed, left)
            running[process] = name, log
        process, status = os.wait()
        name, log = running.pop(process)
        text = log.read_text(errors="replace")
        found = re.search(r"number_of_executed_units: (\d+)", text)
        count, wrong = int(found[1]) if found else 0, status != 0 or found is None
        total, bad = total + count, bad + wrong
        print(f"{name:36} {count:7} files {'BAD' if wrong else ''}", flush=True)
        if wrong:
            print(text[-3000:], flush=True)
            for file in log.parent.glob(f"{log.stem}-*"):
                print(f"    the bytes are in {shutil.copy(file, tempfile.gettempdir())}")
    summary = f"atheris, {each} s a reader: {total} files for {len(READERS)} readers, {bad} of which did anything else."
    print(summary)
    if page is not None:
        write_figures(page, "atheris", summary)
    return int(bad > 0)


def main() -> int:
    if len(sys.argv) > 1 and not sys.argv[1].startswith("--"):
        fuzz_one(sys.argv[1], sys.argv[2:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=100.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    try:
        import atheris  # noqa: F401  (whether it is there)
    except ImportError:
        print("atheris is not installed (it has no wheel for this Python or system): nothing was tried")
        return 0
    return fuzz_all(options.seconds, options.seed, options.write)


if __name__ == "__main__":
    sys.exit(main())
