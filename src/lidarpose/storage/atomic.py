"""Outputs that are whole or absent: written beside their place under another name, then renamed."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidarpose.errors import InputError

# Left-overs of killed runs carry this mark and are cleaned by the next write of the same file.
_MARK = ".lidarpose-part-"


@contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Give a temporary path in the same folder; on success it takes the place of `path`, else it is removed.

    The temporary name keeps the suffix, for writers that choose a format by it. The file is flushed to the disk
    before the rename, so that a power cut leaves either the old file or the new one; not so with `durable` False,
    for large files that can be made again (a killed process leaves the old or the new one all the same).

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clean_left_overs(path)
        if path.is_dir():
            raise InputError(path, "is a folder", expected="the name of a file to write")
        temporary = path.with_name(f"{path.stem}{_MARK}{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
        try:
            yield temporary
            if durable:
                _flush_to_disk(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Give a temporary folder beside `path`; on success it takes the place of `path`, else it is removed.

    What stood at `path` before is deleted in the end: the caller decides whether that may be.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    path = Path(path).resolve()
    mark = f"{_MARK}{os.getpid()}-{secrets.token_hex(4)}"
    temporary, old = path.with_name(path.name + mark), path.with_name(path.name + mark + "-old")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        restore_folder(path)
        temporary.mkdir()
        try:
            yield temporary
            if path.exists():
                path.rename(old)
            temporary.rename(path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            if old.exists() and not path.exists():
                old.rename(path)
            shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise InputError(path, f"cannot be written: {error.strerror or error}") from error


def require_new_folder(path: Path) -> None:
    """InputError if something stands at `path` already, an empty folder excepted."""
    restore_folder(Path(path))
    try:
        taken = path.exists() and not (path.is_dir() and not any(path.iterdir()))
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from error
    if taken:
        raise InputError(
            path, "exists already", expected="a new folder", remedy="Name another folder, or remove this one."
        )


def prepare_folder(path: Path) -> None:
    """Make a folder for results, before work is done that could not be saved. Raises InputError if it cannot be."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            path, f"cannot be made: {error.strerror or error}", expected="a folder for the results"
        ) from error
    if not os.access(path, os.W_OK):
        raise InputError(path, "cannot be written to", expected="a folder for the results")


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _clean_left_overs(path: Path) -> None:
    for left in path.parent.glob(f"{_escape(path.stem)}{_MARK}*{_escape(path.suffix)}"):
        process = left.name.split(_MARK, 1)[1].split("-", 1)[0]
        if not (process.isdigit() and _is_alive(int(process))):
            left.unlink(missing_ok=True)


def restore_folder(path: Path) -> None:
    """Clean what killed runs of `replacing_folder` left; a folder that one had moved aside comes back to its place."""
    path = path.resolve()
    for left in path.parent.glob(f"{_escape(path.name)}{_MARK}*"):
        process = left.name.split(_MARK, 1)[1].split("-", 1)[0]
        if process.isdigit() and not _is_alive(int(process)) and left.is_dir():
            if left.name.endswith("-old") and not path.exists():
                # Killed between the two renames: what stood there before comes back.
                left.rename(path)
            else:
                shutil.rmtree(left, ignore_errors=True)


def _escape(text: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in text)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
