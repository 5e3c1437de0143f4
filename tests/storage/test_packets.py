"""Velodyne packets that the test makes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage.cloud_import import PlaceOptions
from lidarpose.storage.packets import import_packets, read_packets
from tests_support.velodyne import DISTANCE_M, write_pcap

pytest.importorskip("velodyne_decoder", reason="the extra packets is not installed")

# VLP-16 User Manual, table of vertical angles by laser; rings count them from below.
ELEVATION_DEG = {ring: -15.0 + 2.0 * ring for ring in range(16)}


def test_turns_of_a_cylinder(tmp_path: Path) -> None:
    write_pcap(tmp_path / "a.pcap")
    clouds = list(read_packets(tmp_path / "a.pcap"))
    assert len(clouds) >= 3
    whole = clouds[1]
    assert len(whole) == pytest.approx(900 * 32, rel=0.02)
    elevation = np.rad2deg(np.arctan2(whole.points[:, 2], np.linalg.norm(whole.points[:, :2], axis=1)))
    for ring, wanted in ELEVATION_DEG.items():
        # The lasers of a VLP-16 stand at up to 11 mm above and below its centre.
        np.testing.assert_allclose(elevation[whole.fields["ring"] == ring], wanted, atol=0.2)
    np.testing.assert_allclose(np.linalg.norm(whole.points, axis=1), DISTANCE_M, atol=0.012)
    assert np.ptp(whole.fields["time"]) == pytest.approx(0.0995, abs=0.002)
    report = import_packets(tmp_path / "a.pcap", tmp_path / "out", PlaceOptions())
    assert report.summary.startswith("place p00: ")


def test_what_is_no_pcap_of_a_velodyne(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    write_pcap(path, turns=1)
    whole = path.read_bytes()
    for data in (b"", whole[:20], b"\x0a\x0d\x0d\x0a" + whole[4:], whole[:-1], whole[:24], whole[:1000]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"a\.pcap"):
            list(read_packets(path))
