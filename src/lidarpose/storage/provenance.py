"""What is needed to repeat a run: inputs with their hashes, versions, and options."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from lidarpose import __version__
from lidarpose.errors import InputError


def provenance(command: str, folder: Path, files: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON-able record of a run on the files of a folder."""
    return {
        "command": command,
        "options": dict(options),
        "inputs_sha256": {path.relative_to(folder).as_posix(): sha256(path) for path in sorted(set(files))},
        "versions": {
            "lidarpose": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "opencv-python-headless")},
        },
    }


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file. Raises InputError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from error
