"""Files of real sensors, read whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarpose.storage.bag_import import import_bag
from lidarpose.storage.clouds import looks_like_millimetres, read_cloud
from lidarpose.storage.recording import read_recording
from tests_support.real import recording


def test_every_real_pcd_is_read_whole() -> None:
    expected = {"box_jimin": 99, "sweep_suijingfeng": 6, "rot2d_pcl": 1, "roundhole_opencalib": 2}
    for name, files in expected.items():
        found = sorted(recording(name).rglob("*.pcd"))
        assert len(found) == files
        for path in found:
            cloud = read_cloud(path)
            promised = next(line for line in path.read_bytes()[:2000].split(b"\n") if line.startswith(b"POINTS"))
            assert len(cloud) == int(promised.split()[1])
            assert not looks_like_millimetres(cloud)
            extent = np.abs(cloud.finite().points).max()
            assert 0.1 < extent < 300.0


def test_the_fields_of_a_compressed_pcd_are_those_of_its_sensor() -> None:
    """Pandar64: 64 rings, intensities of a byte, times of one turn of a tenth of a second."""
    cloud = read_cloud(sorted(recording("roundhole_opencalib").glob("*.pcd"))[0]).finite()
    assert set(np.unique(cloud.fields["ring"])) <= set(range(64))
    assert 0.0 <= cloud.fields["intensity"].min() <= cloud.fields["intensity"].max() <= 255.0
    assert np.ptp(cloud.fields["timestamp"]) < 0.2


def test_text_clouds_of_a_scanner() -> None:
    for path in sorted(recording("lcct_cmu").rglob("*.xyz")):
        cloud = read_cloud(path)
        assert len(cloud) == sum(1 for line in path.read_text().splitlines() if line.strip())


@pytest.mark.parametrize(
    ("name", "sweeps", "low", "high"),
    [("lidarServo", 295, 60.0, 119.0), ("lidar_servoAngle_2.5hz_5hz", 160, 70.0, 109.0)],
)
def test_a_real_rplidar_on_a_servo(tmp_path: Path, name: str, sweeps: int, low: float, high: float) -> None:
    """298 and 179 scans, 3 and 19 of them without beams; the LiDAR's clock counts from its start."""
    report = import_bag(recording("tilt_rplidar_epfl") / name, tmp_path / "out")
    read = read_recording(tmp_path / "out")
    assert read.sweeps == sweeps
    assert read.has_reading_per_beam
    assert low - 1e-6 <= read.turntable_angle_deg.min() < read.turntable_angle_deg.max() <= high + 1e-6
    beams = np.isfinite(read.range_m)
    assert beams.sum(axis=1).max() <= 600
    assert beams.any(axis=1).mean() > 0.9
    ranges = read.range_m[beams]
    assert 0.05 <= ranges.min() <= ranges.max() <= 10.0
    assert any("another clock" in remark for remark in report.remarks)


def test_a_velodyne_s_packets(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    from lidarpose.storage.packets import read_packets

    clouds = list(read_packets(recording("pcaps") / "sample_velodyne_vlp16_gps.pcap"))
    assert len(clouds) >= 2
    for cloud in clouds:
        assert set(np.unique(cloud.fields["ring"])) <= set(range(16))
        distance = np.linalg.norm(cloud.points, axis=1)
        assert 0.3 < np.median(distance) < 100.0
