"""`calibrate` on simulated sessions, whole and spoilt."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.storage.calibration import read_turntable_calibration
from lidarpose.storage.truth import read_turntable_truth
from tests_support.sessions import PLACES, blank_images, copy_session, edit_text, hide_panel_stripe


@pytest.mark.parametrize("method", ["paper", "joint"])
def test_a_session_becomes_a_calibration(
    simulated_session: Path, tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(simulated_session), "-o", str(tmp_path), "--method", method, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["places"] == {"recorded": PLACES, "used": PLACES}
    assert document["table_1"]["centre_mm"]["mean"] < 1.12
    assert document["table_1"]["z_deg"]["mean"] < 0.203
    assert document["table_1"]["x_deg"]["mean"] < 0.662
    if method == "joint":
        assert 0.0 < document["axis_sigma"]["radius_mm"] < 1.0
        assert 0.0 < document["axis_sigma"]["tilt_deg"] < 0.1
    assert document["error_against_truth"]["arc"]["centre_mm"]["largest"] < 1.0
    assert document["error_against_truth"]["arc"]["rotation_deg"]["largest"] < 0.1
    calibration = read_turntable_calibration(tmp_path / "calibration.json")
    assert "<html" in (tmp_path / "report.html").read_text()[:2000]
    truth = read_turntable_truth(simulated_session)
    assert truth is not None
    metres, radians = calibration.pose(0.1).distance(truth.pose(0.1))
    assert metres < 1e-3
    assert np.rad2deg(radians) < 0.1
    assert (calibration.parameter_covariance is not None) == (method == "joint")
    assert calibration.quality is not None
    assert calibration.quality.verdict == ("good" if method == "joint" else "doubtful")


def test_people_get_a_table_and_the_verdict(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(simulated_session), "-o", str(tmp_path), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "Table 1" in text
    assert "verdict: good" in text
    assert "Error against the truth" in text
    assert "report.html" in text


def test_the_same_input_gives_the_same_output(simulated_session: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run(["calibrate", str(simulated_session), "-o", str(tmp_path / name), "--quiet"]) == 0
    first, second = ((tmp_path / name / "calibration.json").read_bytes() for name in ("a", "b"))
    assert first == second


def test_the_hint_on_the_first_panel_is_taken_or_contradicted(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["calibrate", str(simulated_session), "-o", str(tmp_path), "--method", "paper", "--no-report", "--quiet"]
    statuses = [run([*base, "--first-panel", panel]) for panel in ("1", "2")]
    assert sorted(statuses) == [0, 2]
    assert "--first-panel" in capsys.readouterr().err


def keep_rows(session: Path, count: int) -> None:
    edit_text(session / "positions.csv", lambda text: "\n".join(text.splitlines()[: count + 1]) + "\n")


def empty_scan(session: Path) -> None:
    path = session / "scans/002.csv"
    lines = path.read_text().splitlines()
    columns = lines[0].split(",")
    rows = [line.split(",")[0] + "," * (len(columns) - 1) for line in lines[1:]]
    path.write_text("\n".join([lines[0], *rows]) + "\n")


def swap_rows(text: str) -> str:
    lines = text.splitlines()
    lines[2], lines[3] = lines[3], lines[2]
    return "\n".join(lines) + "\n"


def same_angle(text: str) -> str:
    rows = [line.split(",") for line in text.splitlines()]
    rows[3][1] = rows[2][1]
    return "\n".join(",".join(row) for row in rows) + "\n"


def hide_panel_stripes(paths: list[Path], bright: Path) -> None:
    for path in paths:
        hide_panel_stripe(path, bright, left=True)


FLAWS: dict[str, tuple[Callable[[Path], object], int, str]] = {
    "a missing image": (lambda s: (s / "stripes/001.png").unlink(), 2, "stripes/001.png"),
    "a scan file of no bytes": (lambda s: (s / "scans/002.csv").write_bytes(b""), 2, "scans/002.csv: line 1: is empty"),
    "a truncated image": (
        lambda s: (s / "stripes/001.png").write_bytes((s / "stripes/001.png").read_bytes()[:2000]),
        2,
        "001.png: is cut off",
    ),
    "a wrong board size": (
        lambda s: edit_text(s / "session.toml", lambda t: t.replace("columns = 20", "columns = 17")),
        2,
        "board.panels.0: Panel 1 was not found in the bright images: expected 17 x 14 inner corners; found: 20 x 14",
    ),
    "two equal angles": (lambda s: edit_text(s / "positions.csv", same_angle), 2, "turntable_angle_deg"),
    "angles out of order": (lambda s: edit_text(s / "positions.csv", swap_rows), 2, "--any-order"),
    "only two places": (lambda s: keep_rows(s, 2), 1, "three"),
    "no stripe": (lambda s: blank_images(sorted((s / "stripes").glob("*.png"))), 1, "stripe"),
    "a stripe on one panel": (
        lambda s: hide_panel_stripes(sorted((s / "stripes").glob("*.png")), s / "board/00.png"),
        1,
        "panel",
    ),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_each_flaw_has_its_status_and_a_message(
    simulated_session: Path, tmp_path: Path, flaw: str, capsys: pytest.CaptureFixture[str]
) -> None:
    session = copy_session(simulated_session, tmp_path / "session")
    spoil, status, message = FLAWS[flaw]
    spoil(session)
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == status
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "out" / "calibration.json").exists()


def test_a_scan_without_returns_is_left_out_with_its_reason(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = copy_session(simulated_session, tmp_path / "session")
    empty_scan(session)
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["places"]["used"] == PLACES - 1
    assert {"what": "position 002", "reason": "no beam of its scan has a return"} in document["left_out"]


def test_parallel_panels_are_refused(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = copy_session(simulated_session, tmp_path / "session")
    shutil.rmtree(session / "board")
    (session / "board").mkdir()
    draw_flat_board(session / "board/00.png")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert "parallel" in capsys.readouterr().err


def draw_flat_board(path: Path) -> None:
    """Two chessboards of 20 x 14 inner corners in one plane that faces the camera."""
    import cv2

    image = np.full((1234, 1624), 200, np.uint8)
    size = 36
    columns, rows = np.meshgrid(np.arange(21 * size) // size, np.arange(15 * size) // size)
    squares = np.where((columns + rows) % 2 == 0, 30, 200).astype(np.uint8)
    for top in (40, 650):
        image[top : top + squares.shape[0], 400 : 400 + squares.shape[1]] = squares
    assert cv2.imwrite(str(path), cv2.GaussianBlur(image, (0, 0), 0.8))


@pytest.mark.slow
def test_a_laser_that_no_camera_sees_needs_two_placements_of_the_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--seed", "4", "--places", "8", "--no-stripe", "--quiet"]
    assert run(["simulate", "turntable", str(tmp_path / "two"), "--placements", "2", *common]) == 0
    capsys.readouterr()
    assert run(["calibrate", str(tmp_path / "two"), "-o", str(tmp_path / "out"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["table_1"] is None
    middle = document["sigma"][1]
    error = document["error_against_truth"]["arc"]
    assert error["centre_mm"]["largest"] < 4.0 * middle["centre_mm"]
    assert error["rotation_deg"]["largest"] < 4.0 * middle["rotation_deg"]
    assert run(["simulate", "turntable", str(tmp_path / "one"), *common]) == 0
    assert run(["calibrate", str(tmp_path / "one"), "-o", str(tmp_path / "out1")]) == 1
    assert "two or more placements" in capsys.readouterr().err


def test_exact_scans_are_no_obstacle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "exact"
    options = ["--seed", "3", "--family", "mixed", "--places", "5", "--noise-free", "--quiet"]
    assert run(["simulate", "turntable", str(session), *options]) == 0
    capsys.readouterr()
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--json", "--no-report"]) == 0
    error = json.loads(capsys.readouterr().out)["error_against_truth"]["arc"]
    assert error["centre_mm"]["largest"] < 0.05


def test_what_the_user_sees_on_his_rig_is_compared(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["calibrate", str(simulated_session), "-o", str(tmp_path), "--json", "--no-report"]
    assert run(command) == 0
    note = json.loads(capsys.readouterr().out)["notes"][-1]
    words = note.split("--beams-turn ")[1].split()
    beams, table = words[0], words[2]
    other = {"clockwise": "anticlockwise", "anticlockwise": "clockwise"}[beams.split("-from-")[0]]
    wrong = f"{other}-from-{beams.split('-from-')[1]}"
    # Stated in the session, and on the command line, which goes first.
    session = shutil.copytree(simulated_session, tmp_path / "stated")
    with (session / "session.toml").open("a") as file:
        file.write(f'\n[turning]\nbeams = "{wrong}"\ntable = "{table}"\n')
    command[1] = str(session)
    assert run([*command, "--beams-turn", beams]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "good"
    assert "compared with what was stated" in document["notes"][-1]
    assert run(command) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] == "rejected"
    assert "written in reverse" in document["reasons"][0]


def test_an_offset_of_all_beam_angles_is_explained_not_estimated(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["calibrate", str(simulated_session), "-o", str(tmp_path), "--estimate", "beam-angle-offset"]
    assert run(command) == 2
    assert "turn of the LiDAR about its own z axis" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options",
    [("--axis-beam-deg", "90"), ("--method", "harris"), ("--estimate", "beam-angle-offset"), ("--want-mm", "-1")],
)
def test_refused_options_leave_no_folder(simulated_session: Path, tmp_path: Path, options: tuple[str, ...]) -> None:
    assert run(["calibrate", str(simulated_session), "-o", str(tmp_path / "a/b"), *options]) == 2
    assert not (tmp_path / "a").exists()


def test_readings_off_by_a_factor_are_mended_by_the_calibration_file(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Far from zero, where a factor that was lost on the way would turn the LiDAR by degrees."""
    session, factor, shift = copy_session(simulated_session, tmp_path / "session"), 1.01, 200.0

    def misread(text: str) -> str:
        head, *rows = text.splitlines()
        column = head.split(",").index("turntable_angle_deg")
        cells = [row.split(",") for row in rows]
        for row in cells:
            row[column] = repr(factor * (float(row[column]) + shift))
        return "\n".join([head, *(",".join(row) for row in cells)]) + "\n"

    edit_text(session / "positions.csv", misread)
    command = ["calibrate", str(session), "-o", str(tmp_path / "out"), "--no-report", "--quiet"]
    assert run([*command, "--estimate", "encoder-scale"]) == 0
    calibration = read_turntable_calibration(tmp_path / "out" / "calibration.json")
    truth = read_turntable_truth(simulated_session)
    assert truth is not None
    for true_deg in (2.0, 10.0, 20.0):
        found = calibration.uncertain_pose(float(np.deg2rad(factor * (true_deg + shift))))
        assert found is not None
        xi = found.pose.minus(truth.pose(float(np.deg2rad(true_deg))))
        assert xi @ np.linalg.solve(found.covariance, xi) < 22.5
        assert np.linalg.norm(xi[3:]) < np.deg2rad(0.15)
    capsys.readouterr()
    assert (
        run(["export", str(tmp_path / "out" / "calibration.json"), "--to", "urdf", "-o", str(tmp_path / "rig.urdf")])
        == 2
    )
    assert "off by a factor" in capsys.readouterr().err
