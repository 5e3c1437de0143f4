"""Where a simulated session may be written, and where its truth lies."""

from __future__ import annotations

from pathlib import Path

from lidarpose.errors import InputError
from lidarpose.storage.truth import truth_path


def check_free(folder: Path, session_format: str, *, force: bool = False, head: str = "session.toml") -> None:
    """Whether a session (or recording) may be written to a folder.

    It may if the folder is new or empty, or holds a session with its truth beside it: an earlier simulation, which
    can be made again. One without may be a recording of the world and is replaced only with `force`; anything else
    never. `head` names the file that states the format.

    Raises
    ------
    InputError
        If it may not, or the folder cannot be read.
    """
    kind = session_format.partition("/")[2].partition("@")[0].replace("-", " ")
    try:
        if not folder.exists():
            return
        if not folder.is_dir():
            raise InputError(folder, "is a file", expected="the name of a folder to write")
        if not any(folder.iterdir()):
            return
        description = folder / head
        if not (description.is_file() and session_format in description.read_text("utf-8", errors="replace")):
            raise InputError(folder, f"is not empty and no {kind}", remedy="Name a new folder.")
    except OSError as error:
        raise InputError(folder, f"cannot be read: {error.strerror or error}") from error
    if not (force or truth_path(folder).is_file()):
        raise InputError(
            folder, f"already holds a {kind} without its truth", remedy="Name a new folder, or say --force."
        )
