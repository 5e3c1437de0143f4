"""Text headers of clouds: read within bounds, and written at a fixed length so that counts can be mended at the end."""

from __future__ import annotations

from pathlib import Path

from lidarpose.errors import InputError
from lidarpose.storage.limits import MAX_HEADER_BYTES, MAX_POINTS

# Enough for most headers; reading as much as the longest takes would cost as long as parsing does.
USUAL_HEADER_BYTES = 1 << 12


def read_header_lines(path: Path, last: str) -> tuple[list[str], int]:
    """The header's lines up to the one whose first word is `last`, and the byte offset of what follows."""
    with path.open("rb", buffering=0) as file:
        for size in (USUAL_HEADER_BYTES, MAX_HEADER_BYTES):
            file.seek(0)
            found = _lines_until(file.read(size), last)
            if found is not None:
                return found
    raise InputError(path, f"has no line {last!r} within its first {MAX_HEADER_BYTES} bytes", expected="a whole header")


def _lines_until(head: bytes, last: str) -> tuple[list[str], int] | None:
    """The lines up to the one whose first word is `last`, and where it ends; None if it is not there as a whole."""
    word, at = last.encode(), 0
    # Most often it is found at once; where something else begins with the word, further down.
    while (at := head.find(word, at)) >= 0:
        begin, end = head.rfind(b"\n", 0, at) + 1, head.find(b"\n", at)
        if end < 0:
            return None
        if head[begin:end].decode("latin-1").split(maxsplit=1)[:1] == [last]:
            lines = head[:end].decode("latin-1").split("\n")
            return [line.strip() for line in lines], end + 1
        at += 1
    return None


def whole_number(path: Path, field: str, text: str, *, low: int = 0, high: int = MAX_POINTS) -> int:
    """A count in a header as a number within bounds, else InputError."""
    value = int(text) if text.isascii() and text.isdigit() and len(text) <= 20 else None
    if value is None or not low <= value <= high:
        raise InputError(path, f"is {text[:40]!r}", field=field, expected=f"a whole number from {low} to {high}")
    return value


def fill(lines: list[str], comment: str, length: int) -> bytes:
    """The header `lines` with a comment put after the first, padded so that all is `length` bytes long."""
    rest = sum(len(line) + 1 for line in lines) + len(comment) + 1
    padded = comment + " " * (length - rest)
    return ("\n".join([lines[0], padded, *lines[1:]]) + "\n").encode("ascii")
