"""Coverage-guided damage for one reader, of bounded time. Needs atheris, which is 35 MB and not in the lock.

From the folder ``tests``, with ``pip install atheris``::

    python -m tests_support.atheris_job "cloud.pcd" -max_total_time=60 -rss_limit_mb=1024

An exception that is not one `InputError` ends the job and leaves the bytes in a file, as libFuzzer does.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["lidarpose", "rosbags", "laspy"]):
    from tests_support.bad_bytes import READERS, try_reading


def main() -> None:
    name = sys.argv.pop(1)
    reader = next(reader for reader in READERS if reader.name == name)
    with tempfile.TemporaryDirectory() as folder:
        path, target = reader.make(Path(folder))
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        (corpus / "seed").write_bytes(path.read_bytes())

        def attempt(data: bytes) -> None:
            try_reading(reader, path, target, data)

        atheris.Setup([*sys.argv, "-timeout=2", "-verbosity=1", os.fspath(corpus)], attempt)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
