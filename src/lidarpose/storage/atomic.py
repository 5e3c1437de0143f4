"""Outputs that are whole or absent: written beside their place under another name, then renamed."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lidarpose.errors import InputError

# Left-overs of killed runs carry this mark and are cleaned by the next write of the same file.
_MARK = ".lidarpose-part-"


@contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Give a temporary path in the same folder; on success it takes the place of `path`, else it is removed.

    Folders that were made for it go again, too. The temporary name keeps the suffix, for writers that choose a format
    by it. The file is flushed to the disk before the rename, so that a power cut leaves either the old file or the new
    one; not so with `durable` False, for large files that can be made again (a killed process leaves the old or the
    new one all the same).

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    path = Path(path)
    try:
        with _folder_made_for(path):
            _clean_left_overs(path)
            if path.is_dir():
                raise InputError(path, "is a folder", expected="the name of a file to write")
            temporary = path.with_name(f"{path.stem}{_MARK}{os.getpid()}-{os.urandom(4).hex()}{path.suffix}")
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
    mark = f"{_MARK}{os.getpid()}-{os.urandom(4).hex()}"
    temporary, old = path.with_name(path.name + mark), path.with_name(path.name + mark + "-old")
    try:
        with _folder_made_for(path):
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


@contextmanager
def _folder_made_for(path: Path) -> Iterator[None]:
    """Make the folder that `path` lies in; where the work fails, those that were made go again if they are empty."""
    missing = [folder for folder in path.absolute().parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for folder in missing:
                folder.rmdir()
        raise


def require_apart(output: Path, *inputs: Path | None) -> None:
    """InputError where writing `output` would take the place of a file that the same command reads."""
    place = Path(output).resolve()
    if any(place == source.resolve() for source in inputs if source is not None):
        raise InputError(output, "is read by this command, and would be replaced", expected="another file to write")


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


def require_writable_folder(path: Path) -> None:
    """InputError if a folder for results is not there and could not be made, before work is done for it.

    Nothing is made yet: work that is refused or killed leaves no empty folder.
    """
    path = Path(path)
    for at in (path, *path.absolute().parents):
        try:
            at.lstat()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise InputError(
                path, f"cannot be made: {error.strerror or error}", expected="a folder for the results"
            ) from error
        if not at.is_dir():
            raise InputError(path, f"cannot be made: {at} is no folder", expected="a folder for the results")
        if not os.access(at, os.W_OK | os.X_OK):
            what = "cannot be written to" if at == path else f"cannot be made: {at} cannot be written to"
            raise InputError(path, what, expected="a folder for the results")
        return


def mark_unfinished(folder: Path) -> Path:
    """Put a mark into a folder that is whole but not yet named where readers look; to be removed when it is."""
    mark = folder / f"{_MARK}{os.getpid()}"
    mark.touch()
    return mark


def clean_unfinished(parent: Path, named: Collection[str]) -> None:
    """Remove what killed runs left in a folder of folders: temporary ones, and marked ones that are not `named`."""
    for left in [*parent.glob("*")] if parent.is_dir() else ():
        if _MARK in left.name:
            restore_folder(parent / left.name.split(_MARK, 1)[0])
            continue
        for mark in left.glob(f"{_MARK}*"):
            process = mark.name.removeprefix(_MARK)
            if process.isdigit() and not _is_alive(int(process)):
                if left.name not in named:
                    shutil.rmtree(left, ignore_errors=True)
                mark.unlink(missing_ok=True)


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
