"""Sessions written and read back; a session is whole or absent, and nothing of the user's is overwritten."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.errors import InputError
from lidarpose.model.image import GrayImage
from lidarpose.model.sense import StatedSense
from lidarpose.model.session import TurntableSession
from lidarpose.simulate.rig import draw_rig, paper_camera
from lidarpose.simulate.session import SimulatedSession, SimulationOptions, simulate_session
from lidarpose.storage.session import read_turntable_session
from lidarpose.storage.session_writer import count_files, write_turntable_session

SMALL = ["--width", "406", "--height", "308"]


def small(places: int = 3, placements: int = 1, **options: object) -> SimulatedSession:
    rig = draw_rig(6, places=places, placements=placements, camera=paper_camera(406, 308))
    return simulate_session(rig, options=SimulationOptions(**options))  # type: ignore[arg-type]


def assert_same(read: TurntableSession, written: TurntableSession) -> None:
    np.testing.assert_array_equal(read.camera.K, written.camera.K)
    np.testing.assert_array_equal(read.camera.distortion, written.camera.distortion)
    assert read.panels == written.panels
    assert read.lidar == written.lidar
    assert read.stated == written.stated
    assert set(read.board_images) == set(written.board_images)
    for name, shots in written.board_images.items():
        assert len(read.board_images[name]) == len(shots)
        for a, b in zip(read.board_images[name], shots, strict=True):
            np.testing.assert_array_equal(a.load(), b.load())
    for one, two in zip(read.places, written.places, strict=True):
        assert (one.position, one.placement) == (two.position, two.placement)
        assert one.turntable_angle_rad == pytest.approx(two.turntable_angle_rad, abs=1e-12)
        assert (one.stripe_image is None) == (two.stripe_image is None)
        if one.stripe_image is not None and two.stripe_image is not None:
            np.testing.assert_array_equal(one.stripe_image.load(), two.stripe_image.load())
        scan, other = one.scan.load(), two.scan.load()
        np.testing.assert_allclose(scan.angle_rad, other.angle_rad, atol=1e-12)
        np.testing.assert_allclose(scan.range_m, other.range_m, rtol=1e-11)
        for found, expected in ((scan.intensity, other.intensity), (scan.sweep, other.sweep)):
            assert (found is None) == (expected is None)
            if found is not None and expected is not None:
                np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_a_session_is_read_back_as_it_was(tmp_path: Path) -> None:
    simulated = small()
    steps: list[None] = []
    folder = tmp_path / "deep" / "session"
    write_turntable_session(folder, simulated.session, truth=simulated.truth, step=lambda: steps.append(None))
    assert len(steps) == count_files(simulated.session) == 3 + 3 + 3
    assert_same(read_turntable_session(folder), simulated.session)
    assert sorted(p.name for p in folder.parent.iterdir()) == ["session", "session.truth.json"]


def test_how_the_rig_turns_is_read_and_written(tmp_path: Path) -> None:
    for k, stated in enumerate((StatedSense(table="clockwise-from-right"), StatedSense("anticlockwise-from-above"))):
        session = replace(small().session, stated=stated)
        write_turntable_session(tmp_path / str(k), session)
        assert read_turntable_session(tmp_path / str(k)).stated == stated
    text = (tmp_path / "1" / "session.toml").read_text()
    (tmp_path / "1" / "session.toml").write_text(text.replace("anticlockwise-from-above", "upwards"))
    with pytest.raises(InputError, match=r"turning\.beams"):
        read_turntable_session(tmp_path / "1")


def test_sweeps_placements_and_no_stripe_are_read_back(tmp_path: Path) -> None:
    from lidarpose.simulate.lidar import LidarBehaviour

    simulated = small(placements=2, with_stripe=False, lidar=LidarBehaviour(sweeps=2))
    write_turntable_session(tmp_path / "s", simulated.session)
    assert_same(read_turntable_session(tmp_path / "s"), simulated.session)


def test_the_truth_holds_the_motion(tmp_path: Path) -> None:
    simulated = small()
    write_turntable_session(tmp_path / "s", simulated.session, truth=simulated.truth)
    truth = json.loads((tmp_path / "s.truth.json").read_text())
    matrices = {(t["parent"], t["child"]): np.array(t["matrix"]) for t in truth["transforms"]}
    for place in truth["places"]:
        a = np.deg2rad(place["turntable_angle_deg"])
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        motion = matrices["camera", "turntable"] @ turn @ matrices["turntable", "lidar"]
        np.testing.assert_allclose(motion, place["T_camera_lidar"], atol=1e-12)
    assert len(truth["panels"]) == 2


class Broken:
    name = "broken"

    def load(self) -> GrayImage:
        raise InputError("broken", "cannot be read")


def test_a_write_that_fails_leaves_nothing_or_what_was_there(tmp_path: Path) -> None:
    simulated = small()
    bad_place = replace(simulated.session.places[1], stripe_image=Broken())
    bad = replace(simulated.session, places=(simulated.session.places[0], bad_place))
    with pytest.raises(InputError, match="broken"):
        write_turntable_session(tmp_path / "s", bad, truth=simulated.truth)
    assert list(tmp_path.iterdir()) == []
    write_turntable_session(tmp_path / "s", simulated.session, truth=simulated.truth)
    with pytest.raises(InputError, match="broken"):
        write_turntable_session(tmp_path / "s", bad, truth=simulated.truth)
    assert_same(read_turntable_session(tmp_path / "s"), simulated.session)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s", "s.truth.json"]


def test_left_overs_of_a_killed_run_are_cleaned_and_an_old_session_comes_back(tmp_path: Path) -> None:
    dead = tmp_path / "s.lidarpose-part-999999999-abcd"
    dead.mkdir()
    old = tmp_path / "s.lidarpose-part-999999999-abcd-old"
    old.mkdir()
    (old / "notes.txt").write_text("mine")
    simulated = small()
    # The old folder comes back first, and as it is no session it is not replaced.
    with pytest.raises(InputError, match="no turntable session"):
        write_turntable_session(tmp_path / "s", simulated.session)
    assert (tmp_path / "s" / "notes.txt").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s"]


def test_nothing_of_the_users_is_overwritten(tmp_path: Path) -> None:
    simulated = small()
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "thesis.txt").write_text("years of work")
    for force in (False, True):
        with pytest.raises(InputError, match="not empty"):
            write_turntable_session(precious, simulated.session, force=force)
    assert (precious / "thesis.txt").exists()
    recorded = tmp_path / "recorded"
    write_turntable_session(recorded, simulated.session)
    with pytest.raises(InputError, match="--force"):
        write_turntable_session(recorded, simulated.session)
    write_turntable_session(recorded, simulated.session, force=True)
    with pytest.raises(InputError, match="is a file"):
        write_turntable_session(precious / "thesis.txt", simulated.session)
    (tmp_path / "empty").mkdir()
    write_turntable_session(tmp_path / "empty", simulated.session)
    assert read_turntable_session(tmp_path / "empty").panels == simulated.session.panels


def test_the_command_writes_a_session_and_replaces_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "s")
    assert run(["simulate", "turntable", out, "--places", "4", "--seed", "5", *SMALL, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["places"] == 4
    assert summary["last_angle_deg"] == pytest.approx(21.5)
    assert len(read_turntable_session(tmp_path / "s").places) == 4
    assert run(["simulate", "turntable", out, "--places", "3", "--noise-free", *SMALL]) == 0
    assert "3 places" in capsys.readouterr().out.replace("\n", " ")
    session = read_turntable_session(tmp_path / "s")
    assert len(session.places) == 3
    assert session.lidar.range_sigma_m is None


def test_the_command_refuses_what_makes_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "s")
    for wrong in (
        ["--step-deg", "nan"],
        ["--step-deg", "-1"],
        ["--places", "0"],
        ["--range-sigma-mm", "inf"],
        ["--family", "odd"],
        ["--places", "60", "--step-deg", "5"],
    ):
        assert run(["simulate", "turntable", out, *SMALL, *wrong]) == 2
        assert capsys.readouterr().err.startswith("lidarpose: ")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_command_says_so_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(scan: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarpose.storage.session_writer.scan_text", interrupt)
    assert run(["simulate", "turntable", str(tmp_path / "s"), "--places", "3", *SMALL]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
