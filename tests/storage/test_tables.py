"""CSV: what is taken, and which line is named where it is not."""

from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage.session import read_scan
from lidarpose.storage.tables import read_number_table, read_text_table


def write(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "scan.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_an_empty_range_is_a_beam_without_return(tmp_path: Path) -> None:
    scan = read_scan(write(tmp_path, "angle_deg,range_m,intensity\r\n-5,1.5,10\r\n0,,\r\n5,2,30\r\n"))
    np.testing.assert_allclose(np.rad2deg(scan.angle_rad), [-5, 0, 5])
    np.testing.assert_array_equal(scan.range_m, [1.5, np.nan, 2.0])
    assert scan.intensity is not None
    np.testing.assert_array_equal(scan.intensity, [10.0, np.nan, 30.0])
    assert list(scan.has_return) == [True, False, True]


def test_columns_may_stand_in_any_order_and_behind_a_byte_order_mark(tmp_path: Path) -> None:
    scan = read_scan(write(tmp_path, "range_m,sweep,angle_deg\n1,0,10\n,0,20\n3,1,10\n", "utf-8-sig"))
    np.testing.assert_array_equal(scan.range_m, [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(scan.sweep, [0, 0, 1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("angle_deg,range_m\n", "has no beams"),
        ("angle_deg\n1\n", "the column range_m is missing"),
        ("angle_deg;range_m\n1,5;2,5\n", "has semicolons between its columns"),
        ("angle_deg\trange_m\n1\t2\n", "has tabs between its columns"),
        ("angle_deg,range_m,range_m\n1,2,3\n", "stands twice"),
        ("angle_deg,range_mm\n1,2\n", "range_m"),
        ("angle_deg,range_m\n1,2\n2\n", "line 3 has 1 values"),
        ("angle_deg,range_m\n1,2\n2,nan\n", "line 3 has 'nan'"),
        ("angle_deg,range_m\n1,2\n2,inf\n", "line 3 has 'inf'"),
        ("angle_deg,range_m\n1,2\n,3\n", "line 3 has ''"),
        ("angle_deg,range_m\n1,2\n2,1_0\n", "line 3 has '1_0'"),
        ("angle_deg,range_m\n1,2\n2,0\n", "Leave the range empty"),
        ("angle_deg,range_m\n1,2\n2,-3\n", "metres above zero"),
        ("angle_deg,range_m\n1,1502\n2,1503\n", "divided by 1000"),
        ("angle_deg,range_m\n1,2\n1,2\n", "repeats in row 2"),
        ("angle_deg,range_m\n1,2\n3,2\n2,2\n", "turns back in row 3"),
        ("angle_deg,range_m\n1,2\n2,2\0\n", "zero bytes"),
    ],
)
def test_a_bad_scan_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_scan(write(tmp_path, text))
    assert "scan.csv" in str(caught.value)


def test_text_in_another_encoding_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "positions.csv"
    path.write_bytes(b"position\n\xff\xfe\n")
    with pytest.raises(InputError, match="not UTF-8"):
        read_text_table(path, ("position",))


def test_beams_may_pass_from_359_to_0_degrees(tmp_path: Path) -> None:
    scan = read_scan(write(tmp_path, "angle_deg,range_m\n358,1\n359,1\n0,1\n1,1\n"))
    assert len(scan) == 4


@pytest.mark.parametrize("text", ["a,b\r-c\n1,2\n", "a\rb\n", 'a,b\n"' + 200_000 * "x" + '",2\n', "a,b\n1,2\r3\n"])
def test_what_the_csv_parser_itself_refuses(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.csv").write_bytes(text.encode())
    for read in (read_text_table, read_number_table):
        with pytest.raises(InputError, match=r"t\.csv"):
            read(tmp_path / "t.csv", ("a", "b"))
