"""Outputs are whole or absent."""

from pathlib import Path

import pytest

from lidarpose.errors import InputError
from lidarpose.storage.atomic import replacing, replacing_folder, require_writable_folder, write_text


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


def test_a_refusal_leaves_no_folders(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    for write in (replacing, replacing_folder):
        with pytest.raises(InputError), write(tmp_path / "there/a/b/c.txt"):
            raise InputError("data", "is bad")
    assert [p.name for p in tmp_path.rglob("*")] == ["there"]


def test_a_folder_is_found_writable_without_being_made(tmp_path: Path) -> None:
    require_writable_folder(tmp_path)
    require_writable_folder(tmp_path / "a/b")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    for wrong in ("file", "file/a", "file/a/b", "x" * 300):
        with pytest.raises(InputError, match="cannot be made"):
            require_writable_folder(tmp_path / wrong)
