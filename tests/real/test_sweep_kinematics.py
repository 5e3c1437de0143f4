"""Real spun 2D LiDARs put through the package: angles and ranges recovered from a cloud give the cloud back."""

from pathlib import Path

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose
from lidarpose.measure.assemble import assemble
from lidarpose.measure.cloud_beams import recording_from_cloud
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.recording import read_recording, write_recording

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
TILT = DATA / "tilt_sick_3dtk" / "scan000.3d"
LONG_ARM = DATA / "longarm_scvision" / "batchScanned20191114103039.txt"
NO_RETURN_M = 32.7

# The scanner tilts about its own beam at 0 degrees, which is x of the file; there is no arm.
AXIS_ALONG_X = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
BEAM_0_ALONG_AXIS = np.column_stack([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
TILTING = TurntableMotion(Pose(AXIS_ALONG_X, np.zeros(3)), Pose(BEAM_0_ALONG_AXIS, np.zeros(3)))


def tilted_cloud() -> np.ndarray:
    """Points (226, 360, 3) in metres, right-handed: x right, y down, z forward."""
    if not TILT.is_file():
        pytest.skip(f"real recordings are missing: {TILT}")
    left_handed_cm = np.loadtxt(TILT).reshape(226, 360, 3)
    return left_handed_cm * [0.01, -0.01, 0.01]


def test_a_tilting_scanner_gives_its_cloud_back() -> None:
    cloud = tilted_cloud()
    seen = np.linalg.norm(cloud, axis=-1) < NO_RETURN_M
    across = np.hypot(cloud[..., 1], cloud[..., 2])
    beam = np.median(np.arctan2(across, cloud[..., 0]), axis=0)
    tilt = np.arctan2(cloud[..., 2], cloud[..., 1])
    # The longest arm of each sweep tells its tilt best.
    reading = np.array([np.median(t[a > np.quantile(a, 0.8)]) for t, a in zip(tilt, across, strict=True)])
    ranges = np.where(seen, np.linalg.norm(cloud, axis=-1), np.nan)
    recording = SweepRecording("tilt", np.rad2deg(reading), np.rad2deg(beam), ranges)
    again = assemble(recording, TILTING, dtype=np.float64)
    size = np.linalg.norm(np.ptp(cloud[seen], axis=0))
    assert np.abs(again - cloud)[seen].max() < 1e-6 * size
    assert np.isnan(again[~seen]).all()
    # The steps of the instrument come out of the recovered angles.
    assert np.median(np.diff(np.rad2deg(beam))) == pytest.approx(0.5, abs=1e-4)
    assert np.median(np.diff(np.rad2deg(reading))) == pytest.approx(0.5169, abs=2e-4)


def test_recovers_the_tilting_scanners_sweeps_from_its_points_alone() -> None:
    """The file's six digits leave angles of far points alone sharp enough to be told apart; near ones are left out."""
    cloud = tilted_cloud()
    rounded = np.zeros(cloud.shape[:2], dtype=bool)
    rounded[60:100, 40:140] = True
    distance = np.linalg.norm(cloud, axis=-1)
    points = cloud[rounded & (distance > 0.5) & (distance < NO_RETURN_M)]
    recording = recording_from_cloud(points, TILTING)
    assert recording is not None
    assert recording.sweeps == 40
    assert recording.beams == 100


def test_a_long_arm_is_assembled_as_its_poses_say(tmp_path: Path) -> None:
    if not LONG_ARM.is_file():
        pytest.skip(f"real recordings are missing: {LONG_ARM}")
    rows = np.loadtxt(LONG_ARM, delimiter=",")
    ranges = np.where(rows[1:, 3:] > 0.0, rows[1:, 3:], np.nan).astype(np.float32)
    recording = SweepRecording("arm", rows[1:, 2], rows[0, 3:], ranges, time_s=rows[1:, 1] * 1e-3)
    write_recording(tmp_path / "arm", recording)
    motion = TurntableMotion(
        Pose.exp([0.3, -0.2, 0.1, 0.5, -0.3, 0.2]),
        Pose(Pose.exp([0.0, 0.0, 0.0, 1.2, 0.4, -0.3]).rotation, np.array([0.35, 0.0, 0.0])),
    )
    points = assemble(read_recording(tmp_path / "arm"), motion)
    theta = np.deg2rad(rows[0, 3:])
    for sweep in (0, 17, 40):
        T = motion.pose(np.deg2rad(rows[1 + sweep, 2])).matrix
        plane = np.stack([ranges[sweep] * np.cos(theta), ranges[sweep] * np.sin(theta), 0.0 * theta, 1.0 + 0.0 * theta])
        expected = (T @ plane)[:3].T
        np.testing.assert_allclose(points[sweep], expected, atol=2e-6)
    assert np.count_nonzero(np.isfinite(points[..., 0])) == np.count_nonzero(ranges > 0.0)
