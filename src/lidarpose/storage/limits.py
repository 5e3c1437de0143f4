"""What no file may cost: sizes are checked against the file before anything is parsed or allocated.

Readers follow three rules. A file is opened only if it is a regular file. A count in a header is believed only after
it was compared with the bytes that are there. Nothing that inflates is inflated beyond what its format can honestly
reach from the bytes that are there.
"""

from __future__ import annotations

import stat
from pathlib import Path, PurePosixPath

from lidarpose.errors import InputError

MAX_HEADER_BYTES = 1 << 16
"""No text header of a cloud is longer; real ones have some hundred bytes."""
MAX_POINTS = 1 << 36
"""A cloud of more points is a forged header: the largest scanners write some 10^10."""


def file_size(path: Path) -> int:
    """Size in bytes of a regular file.

    Raises
    ------
    InputError
        If there is no such file, or if it is a folder, a pipe or a device.
    """
    try:
        status = (path if isinstance(path, Path) else Path(path)).stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(path, f"cannot be read: {reason}", expected="an existing file") from error
    if not stat.S_ISREG(status.st_mode):
        raise InputError(path, "is not a regular file", expected="a file, not a folder, pipe or device")
    return status.st_size


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that no file can have is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def find_files(folder: Path, pattern: str) -> list[Path] | None:
    """The files of a folder that match a pattern, sorted; None if the pattern leads out of the folder or is none.

    `**` stands for folders of any depth, alone and once.
    """
    relative = PurePosixPath(pattern)
    parts = relative.parts
    deep = [part for part in parts if "**" in part]
    if relative.is_absolute() or not parts or ".." in parts or len(parts) > 32 or "\0" in pattern:
        return None
    if deep not in ([], ["**"]) or max(len(part.encode()) for part in parts) > 255:
        return None
    return sorted(path for path in folder.glob(str(relative)) if is_file(path))


def require_count(path: Path, field: str, count: int, limit: int = MAX_POINTS) -> int:
    """`count` if it lies in [0, limit], else InputError."""
    if not 0 <= count <= limit:
        raise InputError(path, f"is {count}", field=field, expected=f"a count between 0 and {limit}")
    return count


def require_bytes(path: Path, field: str, needed: int, available: int) -> None:
    """InputError if the header promises `needed` bytes where only `available` are left."""
    if needed > available:
        raise InputError(
            path,
            f"the header promises {needed} bytes, but {available} are there",
            field=field,
            expected="a complete file",
            remedy="The file was cut off or its header is damaged; copy or record it again.",
        )
