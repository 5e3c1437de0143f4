"""A stranger's way through the program: a bag in, a robot description out, and `pose` says the same."""

from __future__ import annotations

import json
from pathlib import Path

import kinpy
import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.storage.calibration import read_turntable_calibration
from lidarpose.storage.session import read_turntable_session
from tests_support import bags

START = 1.7e9


def bag_of(session_folder: Path, folder: Path, kind: str) -> Path:
    """A simulated session as a bag: board images, then two seconds at each stop, with joint states throughout."""
    session, make = read_turntable_session(session_folder), bags.messages(kind)
    camera = session.camera
    entries = [("/camera_info", START, make.camera(camera.width, camera.height, camera.K, camera.distortion))]
    time = START
    (board,) = session.board_images.values()
    for image in board:
        time += 0.2
        entries.append(("/image_raw", time + 0.01, make.image(time, image.load(), "mono8")))
    for place in session.places:
        time += 0.5
        for k in range(41):
            stamp = time + 0.05 * k
            entries.append(("/joint_states", stamp + 0.002, make.joint(stamp, place.turntable_angle_rad)))
        scan = place.scan.load()
        first, last = float(scan.angle_rad[0]), float(scan.angle_rad[-1])
        step = (last - first) / (len(scan) - 1)
        more = {"angle_min": first, "angle_max": last, "angle_increment": step, "range_max": 100.0}
        ranges = np.where(scan.has_return, scan.range_m, np.inf)
        intensities = np.zeros(0, dtype=np.float32)
        if scan.intensity is not None:
            intensities = np.nan_to_num(scan.intensity).astype(np.float32)
        message = make.scan(time + 0.5, ranges, **more, time_increment=1e-5, intensities=intensities)
        entries.append(("/scan", time + 0.55, message))
        assert place.stripe_image is not None
        entries.append(("/image_raw", time + 1.2, make.image(time + 1.2, place.stripe_image.load(), "mono8")))
        time += 2.0
    return bags.write_bag(folder, kind, entries)


def truth_of(folder: Path) -> TurntableCalibration:
    """The true motion of the simulated session, whose file has a calibration's transforms."""
    document = json.loads((folder / "simulated.truth.json").read_text())
    kept = {"format": "lidarpose/calibration@1", "kind": "turntable", "transforms": document["transforms"]}
    (folder / "truth.json").write_text(json.dumps(kept))
    return read_turntable_calibration(folder / "truth.json")


@pytest.mark.slow
def test_from_a_bag_to_a_robot_description(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulated, session, out = tmp_path / "simulated", tmp_path / "session", tmp_path / "out"
    assert run(["simulate", "turntable", str(simulated), "--seed", "3", "--places", "20", "--quiet"]) == 0
    bag = bag_of(simulated, tmp_path, "mcap-zstd")
    panels = ["--panel", "20x14x0.020"] * 2
    assert run(["import", str(bag), str(session), *panels, "--range-sigma-m", "0.001"]) == 0
    same, wanted = read_turntable_session(session), read_turntable_session(simulated)
    assert len(same.places) == len(wanted.places)
    for a, b in zip(same.places, wanted.places, strict=True):
        assert a.turntable_angle_rad == pytest.approx(b.turntable_angle_rad, abs=1e-9)
        np.testing.assert_allclose(a.scan.load().range_m, b.scan.load().range_m, rtol=1e-6)
        assert a.stripe_image is not None
        assert b.stripe_image is not None
        np.testing.assert_array_equal(a.stripe_image.load(), b.stripe_image.load())
    assert run(["calibrate", str(session), "-o", str(out)]) == 0
    calibration, urdf = str(out / "calibration.json"), tmp_path / "robot.urdf"
    assert run(["export", calibration, "--to", "urdf", "-o", str(urdf)]) == 0
    chain = kinpy.build_chain_from_urdf(urdf.read_bytes())
    truth = truth_of(tmp_path)
    for angle_deg in (0.0, 13.7, 191.0):
        capsys.readouterr()
        assert run(["pose", calibration, "--angle-deg", str(angle_deg), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        posed = np.array(told["matrix"])
        found = chain.forward_kinematics({"turntable_joint": np.deg2rad(angle_deg)})["lidar"].matrix()
        np.testing.assert_allclose(found, posed, rtol=0.0, atol=1e-9)
        true = truth.pose(np.deg2rad(angle_deg)).matrix
        assert np.all(np.abs(found[:3, 3] - true[:3, 3]) * 1e3 < 5.0 * np.array(told["sigma_translation_mm"]))
