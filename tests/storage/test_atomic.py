"""Outputs are whole or absent."""

from pathlib import Path

import pytest

from lidarpose.errors import InputError
from lidarpose.storage.atomic import replacing, write_text


def test_a_failure_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_left_overs_of_dead_processes_are_cleaned(tmp_path: Path) -> None:
    left = tmp_path / "a.lidarpose-part-999999999-abcd.txt"
    left.write_text("half")
    write_text(tmp_path / "a.txt", "new")
    assert not left.exists()


def test_a_folder_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        write_text(tmp_path / "a.txt", "x")
