"""Strict CSV: named columns, one record a line, and errors that name the line.

The body goes through numpy's C parser; only where that stumbles is the file read again, slowly, to find the line.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.storage.documents import shown

MAX_TABLE_BYTES = 32 * 2**20
"""Of numbers: a million beams and a half."""
MAX_TEXT_TABLE_BYTES = 4 * 2**20
_MAX_LINE_BYTES = 2**16
_BLOCK = 2**20


@dataclass(frozen=True)
class TextTable:
    """A small table as text: rows by column name, and the line of the file on which each row stands."""

    path: Path
    columns: tuple[str, ...]
    rows: tuple[Mapping[str, str], ...]
    lines: tuple[int, ...]

    def number(self, row: int, column: str) -> float:
        """A finite number from a cell; raises InputError naming line and column."""
        text = self.rows[row][column].strip()
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        # float() also takes "nan", "infinity" and "1_000": none of them is a number in a table.
        if not np.isfinite(value) or "_" in text:
            raise InputError(
                self.path, f"line {self.lines[row]} has {shown(text)}", field=column, expected="a finite number"
            )
        return value


def read_text_table(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> TextTable:
    """Read a small table whole.

    Raises
    ------
    InputError
        If it is missing, not UTF-8, lacks a required column, has one that is not known, or a row of another length.
    """
    records = list(_records(path, _read_text(path, MAX_TEXT_TABLE_BYTES)))
    columns = _check_header(path, records[0] if records else [], required, optional)
    rows, lines = [], []
    for number, record in enumerate(records[1:], start=2):
        if not any(cell.strip() for cell in record):
            continue
        if len(record) != len(columns):
            raise _wrong_width(path, number, len(record), columns)
        rows.append(dict(zip(columns, (cell.strip() for cell in record), strict=True)))
        lines.append(number)
    return TextTable(path, columns, tuple(rows), tuple(lines))


def read_number_table(
    path: Path, required: Sequence[str], optional: Sequence[str] = (), may_be_empty: Sequence[str] = ()
) -> dict[str, FloatArray]:
    """Read columns of numbers (N,) by name; empty cells are NaN in the columns that may have them.

    Raises
    ------
    InputError
        As `read_text_table`, and for a cell that is no finite number or is empty where it must not be.
    """
    text = _read_text(path, MAX_TABLE_BYTES)
    first, _, _ = text.partition("\n")
    columns = _check_header(path, next(_records(path, first), []), required, optional)
    gaps_allowed = np.array([name in may_be_empty for name in columns])
    line, start = 2, len(first) + 1
    tables: list[FloatArray] = [np.zeros((0, len(columns)))]
    while start < len(text):
        # Blocks of whole lines: what is odd is found in its block, and little memory is needed at a time.
        end = text.find("\n", start + _BLOCK) + 1 or len(text)
        block = text[start:end]
        if block.strip():
            tables.append(_parse_block(path, block, line, columns, gaps_allowed))
        line, start = line + block.count("\n"), end
    table = np.concatenate(tables)
    return {name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(columns)}


def _parse_block(path: Path, body: str, line: int, columns: tuple[str, ...], gaps_allowed: BoolArray) -> FloatArray:
    table = _parse_numbers(body, len(columns))
    if table is None or np.isinf(table).any() or np.isnan(table[:, ~gaps_allowed]).any() or "nan" in body.lower():
        table = _parse_slowly(path, body, line, columns, gaps_allowed)
    return table


def _records(path: Path, text: str) -> Iterator[list[str]]:
    try:
        yield from csv.reader(io.StringIO(text, newline=""))
    except csv.Error as error:
        raise InputError(path, f"is no CSV table: {error}", expected="lines of values apart by commas") from error


def _parse_numbers(body: str, width: int) -> FloatArray | None:
    """All cells as numbers, empty ones as NaN; None if anything is odd."""
    body = body.replace("\r\n", "\n").replace(" ", "")
    if not body.endswith("\n"):
        body += "\n"
    while ",," in body:
        body = body.replace(",,", ",nan,")
    body = body.replace(",\n", ",nan\n").replace("\n,", "\nnan,")
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2, comments=None)
    except ValueError:
        return None
    return table if table.shape[1] == width else None


def _parse_slowly(path: Path, body: str, line: int, columns: tuple[str, ...], gaps_allowed: BoolArray) -> FloatArray:
    rows = []
    for number, record in enumerate(_records(path, body), start=line):
        if not any(cell.strip() for cell in record):
            continue
        if len(record) != len(columns):
            raise _wrong_width(path, number, len(record), columns)
        cells = zip(columns, record, gaps_allowed, strict=True)
        rows.append([_number(path, number, name, cell.strip(), bool(gap)) for name, cell, gap in cells])
    return np.array(rows, dtype=np.float64).reshape(-1, len(columns))


def _number(path: Path, line: int, column: str, text: str, may_be_empty: bool) -> float:
    if not text and may_be_empty:
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value) or "_" in text:
        expected = "a finite number" + (", or nothing at all" if may_be_empty else "")
        raise InputError(path, f"line {line} has {shown(text)}", field=column, expected=expected)
    return value


def _read_text(path: Path, limit: int) -> str:
    try:
        if not path.is_file():
            raise InputError(path, "is missing" if not path.exists() else "is not a file", expected="a CSV table")
        if path.stat().st_size > limit:
            raise InputError(path, f"is larger than {limit // 2**20} MB", expected="a CSV table")
        data = path.read_bytes()
        _check_lines(path, data)
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(path, f"byte {error.start} is not UTF-8 text", expected="a CSV table in UTF-8") from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from error
    if text.count("\r") != text.count("\r\n"):
        raise InputError(path, "has carriage returns inside its lines", expected="lines that end by LF or CR LF")
    if "\0" in text:
        raise InputError(path, "holds zero bytes", expected="a CSV table in UTF-8")
    return text


def _check_lines(path: Path, data: bytes) -> None:
    """InputError if a line is longer than any row."""
    start = 0
    while len(data) - start > _MAX_LINE_BYTES:
        end = data.rfind(b"\n", start, start + _MAX_LINE_BYTES)
        if end < 0:
            line = data.count(b"\n", 0, start) + 1
            raise InputError(path, "is too long", field=f"line {line}", expected="a row of a CSV table")
        start = end + 1


def _check_header(
    path: Path, header: Sequence[str], required: Sequence[str], optional: Sequence[str]
) -> tuple[str, ...]:
    columns = tuple(name.strip() for name in header)
    wanted = ",".join(required) + "".join(f"[,{name}]" for name in optional)
    if not any(columns):
        raise InputError(path, "is empty", field="line 1", expected=f"the header {wanted}")
    other = {";": "semicolons", "\t": "tabs"}.get(next((c for c in ";\t" if c in header[0]), ""))
    if len(columns) == 1 and len(required) > 1 and other:
        raise InputError(
            path, f"has {other} between its columns", field="line 1", expected="commas, and decimal points"
        )
    for name in required:
        if name not in columns:
            raise InputError(path, f"the column {name} is missing", field="line 1", expected=f"the header {wanted}")
    for name in columns:
        if name not in required and name not in optional:
            raise InputError(path, f"unknown column {shown(name)}", field="line 1", expected=f"the header {wanted}")
    if len(set(columns)) != len(columns):
        raise InputError(path, "a column stands twice", field="line 1", expected=f"the header {wanted}")
    return columns


def _wrong_width(path: Path, line: int, found: int, columns: tuple[str, ...]) -> InputError:
    return InputError(
        path,
        f"line {line} has {found} values",
        field=f"line {line}",
        expected=f"{len(columns)}: {','.join(columns)}",
        remedy="The file may be cut off; record or copy it again.",
    )
