"""Turntable sessions: a good one is read as it was meant; each flaw has a message that names file and field."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage.camera_info import write_camera_info
from lidarpose.storage.session import first_out_of_order, read_turntable_session
from tests_support.cameras import small_camera

TOML = """\
format = "lidarpose/turntable-session@1"
camera = "camera.yaml"
positions = "positions.csv"
[board]
images = "board/*.png"
[[board.panels]]
columns = 20
rows = 14
square_m = 0.020
[[board.panels]]
columns = 10
rows = 7
square_m = 0.04
[lidar]
model = "LMS"
range_sigma_m = 1e-3
"""
POSITIONS = """\
position,turntable_angle_deg,stripe_image,scan
a,10,stripes/000.png,scans/000.csv
b,10.25,stripes/001.png,scans/001.csv
c,10.5,,scans/002.csv
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("board", "stripes", "scans"):
        (tmp_path / name).mkdir()
    (tmp_path / "session.toml").write_text(TOML)
    (tmp_path / "positions.csv").write_text(POSITIONS)
    write_camera_info(tmp_path / "camera.yaml", small_camera())
    image = np.full((48, 64), 100, np.uint8)
    for name in ("board/0.png", "stripes/000.png", "stripes/001.png"):
        cv2.imwrite(str(tmp_path / name), image)
    for k in range(3):
        (tmp_path / f"scans/{k:03d}.csv").write_text("angle_deg,range_m\n0,1\n1,\n2,1.25\n")
    return tmp_path


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_session_is_read_as_it_was_meant(folder: Path) -> None:
    session = read_turntable_session(folder)
    assert [p.position for p in session.places] == ["a", "b", "c"]
    np.testing.assert_allclose(np.rad2deg([p.turntable_angle_rad for p in session.places]), [10, 10.25, 10.5])
    assert session.places[2].stripe_image is None
    assert session.panels[0].columns == 20
    assert session.lidar.range_sigma_m == 1e-3
    np.testing.assert_allclose(session.camera.K, small_camera().K)
    assert session.places[0].stripe_image is not None
    assert session.places[0].stripe_image.load().shape == (48, 64)
    assert len(session.places[0].scan.load()) == 3
    assert [s.name for s in session.board_images[""]] == ["board/0.png"]


def test_placements_have_sub_folders(folder: Path) -> None:
    (folder / "board/left").mkdir()
    (folder / "board/0.png").rename(folder / "board/left/0.png")
    rows = POSITIONS.replace(",scan\n", ",scan,placement\n").replace(".csv\n", ".csv,left\n")
    (folder / "positions.csv").write_text(rows)
    session = read_turntable_session(folder)
    assert [s.name for s in session.board_images["left"]] == ["board/left/0.png"]
    assert {p.placement for p in session.places} == {"left"}


def _without_second_panel(file: Path) -> None:
    first, _, rest = file.read_text().rpartition("[[board.panels]]")
    file.write_text(first + rest[rest.index("[lidar]") :])


FLAWS = {
    "no session.toml": (lambda f: (f / "session.toml").unlink(), "session.toml: is missing"),
    "not toml": (lambda f: (f / "session.toml").write_text("format = "), "not valid TOML"),
    "other format": (lambda f: replace(f / "session.toml", "session@1", "session@2"), "version 1 only"),
    "unknown key": (lambda f: replace(f / "session.toml", "columns = 20", "colums = 20"), "board.panels.0"),
    "millimetres": (lambda f: replace(f / "session.toml", "square_m = 0.020", "square_m = 20"), "square_m"),
    "columns as text": (lambda f: replace(f / "session.toml", "columns = 20", 'columns = "20"'), "columns"),
    "nan sigma": (lambda f: replace(f / "session.toml", "1e-3", "nan"), "range_sigma_m"),
    "one panel too many": (
        lambda f: replace(f / "session.toml", "[lidar]", "[[board.panels]]\ncolumns=5\nrows=5\nsquare_m=0.1\n[lidar]"),
        "board.panels",
    ),
    "one panel": (lambda f: _without_second_panel(f / "session.toml"), "board.panels: has 1; expected at least 2"),
    "no camera": (lambda f: (f / "camera.yaml").unlink(), "camera: names 'camera.yaml', which is missing"),
    "no board images": (lambda f: (f / "board/0.png").unlink(), "board.images: no image matches"),
    "missing stripe image": (lambda f: (f / "stripes/001.png").unlink(), "line 3: stripe_image: names"),
    "missing scan": (lambda f: (f / "scans/002.csv").unlink(), "line 4: scan: names"),
    "two files missing": (
        lambda f: [(f / f"scans/00{k}.csv").unlink() for k in (1, 2)],
        "2 of 5 files are missing: scans/001.csv (line 3), scans/002.csv (line 4)",
    ),
    "file outside": (
        lambda f: replace(f / "positions.csv", "scans/002", "../scans/002"),
        "inside the session's folder",
    ),
    "equal angles": (lambda f: replace(f / "positions.csv", "10.25", "10"), "stands in lines 2 and 3"),
    "angles out of order": (lambda f: replace(f / "positions.csv", "10.25", "11"), "turn back at line 4"),
    "angle is nan": (lambda f: replace(f / "positions.csv", "10.25", "nan"), "line 3 has 'nan'"),
    "same position twice": (
        lambda f: replace(f / "positions.csv", "b,", "a,"),
        "position: 'a' stands in lines 2 and 3",
    ),
    "same scan twice": (
        lambda f: replace(f / "positions.csv", "002.csv", "001.csv"),
        "scan: 'scans/001.csv' stands in",
    ),
    "no positions": (lambda f: (f / "positions.csv").write_text(POSITIONS.splitlines()[0] + "\n"), "has no positions"),
    "short row": (lambda f: replace(f / "positions.csv", "c,10.5,,", "c,10.5,"), "line 4 has 3 values"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_each_flaw_is_named(folder: Path, flaw: str) -> None:
    spoil, message = FLAWS[flaw]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        read_turntable_session(folder)
    assert message in str(caught.value)


def test_equal_and_unordered_angles_can_be_meant(folder: Path) -> None:
    replace(folder / "positions.csv", "10.25", "11")
    assert len(read_turntable_session(folder, any_order=True).places) == 3


def test_a_cut_off_image_and_one_of_another_size_are_named(folder: Path) -> None:
    session = read_turntable_session(folder)
    image, other = session.places[0].stripe_image, session.places[1].stripe_image
    assert image is not None
    assert other is not None
    path = folder / "stripes/000.png"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match=r"000\.png: is cut off"):
        image.load()
    cv2.imwrite(str(folder / "stripes/001.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match="is 10 x 10 pixels; expected 64 x 48"):
        other.load()


def test_order_of_readings() -> None:
    assert first_out_of_order(np.array([350.0, 355.0, 0.0, 5.0])) is None
    assert first_out_of_order(np.array([5.0, 4.0, -9.0])) is None
    assert first_out_of_order(np.array([0.0, 200.0, 350.0])) is None
    assert first_out_of_order(np.array([0.0, 1.0, 0.5])) == 2
