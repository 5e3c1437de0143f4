"""Sweep recordings: round trips, and refusals that name the file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.simulate.disk_scene import rig_motion
from lidarpose.storage.recording import read_recording, release_pages, write_recording, write_simulated_recording


@pytest.fixture
def recording() -> SweepRecording:
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1.0, 2.0, (5, 8)).astype(np.float32)
    ranges[2, 3] = np.nan
    return SweepRecording(
        "rec",
        np.arange(5) * 0.05,
        np.arange(8) * 0.0833,
        ranges,
        intensity=rng.integers(0, 255, (5, 8)).astype(np.uint8),
        time_s=np.arange(5) * 0.02,
        lidar=LidarSpec('SICK "LMS4121R"', 0.001),
    )


def test_reads_what_it_wrote(recording: SweepRecording, tmp_path: Path) -> None:
    write_recording(tmp_path / "rec", recording)
    again = read_recording(tmp_path / "rec")
    for name in ("turntable_angle_deg", "beam_angle_deg", "range_m", "intensity", "time_s"):
        np.testing.assert_array_equal(getattr(again, name), getattr(recording, name))
    assert again.lidar == recording.lidar
    assert again.name == "rec"
    assert isinstance(again.range_m, np.memmap)
    release_pages(again)
    np.testing.assert_array_equal(again.range_m, recording.range_m)


def test_optional_arrays_may_be_missing(recording: SweepRecording, tmp_path: Path) -> None:
    write_recording(tmp_path / "rec", recording)
    per_beam = recording.turntable_angle_deg[:, None] + np.linspace(0, 0.05, 8)
    write_recording(
        tmp_path / "rec",
        replace(recording, turntable_angle_deg=per_beam, intensity=None, time_s=None, lidar=LidarSpec()),
    )
    again = read_recording(tmp_path / "rec")
    assert again.intensity is None
    assert again.time_s is None
    assert again.has_reading_per_beam
    assert again.lidar == LidarSpec()


def test_nothing_but_a_recording_is_replaced(recording: SweepRecording, tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    write_recording(folder, recording)
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="notes"):
        write_recording(folder, recording)
    assert (folder / "notes.txt").read_text() == "mine"
    (folder / "notes.txt").unlink()
    # Without truth beside it this may be a recording of the world.
    with pytest.raises(InputError, match="already holds a sweep recording"):
        write_simulated_recording(folder, recording, rig_motion())
    write_simulated_recording(folder, recording, rig_motion(), force=True)
    write_simulated_recording(folder, recording, rig_motion())


def cut_short(folder: Path) -> None:
    data = (folder / "range_m.npy").read_bytes()
    (folder / "range_m.npy").write_bytes(data[:-10])


def absurd_shape(folder: Path) -> None:
    data = (folder / "range_m.npy").read_bytes()
    (folder / "range_m.npy").write_bytes(data.replace(b"(5, 8), }        ", b"(500000000, 8), }"[:17], 1))


def pickled(folder: Path) -> None:
    np.save(folder / "range_m.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)


def other_shape(folder: Path) -> None:
    np.save(folder / "beam_angle_deg.npy", np.arange(9.0))


def millimetres(folder: Path) -> None:
    np.save(folder / "range_m.npy", np.full((5, 8), 3000.0, np.float32))


def nan_angle(folder: Path) -> None:
    np.save(folder / "turntable_angle_deg.npy", np.array([0.0, 1.0, np.nan, 2.0, 3.0]))


def backwards(folder: Path) -> None:
    np.save(folder / "time_s.npy", np.array([0.0, 1.0, 0.5, 2.0, 3.0]))


def integers(folder: Path) -> None:
    np.save(folder / "range_m.npy", np.ones((5, 8), np.int32))


def no_head(folder: Path) -> None:
    (folder / "recording.toml").unlink()


def other_format(folder: Path) -> None:
    (folder / "recording.toml").write_text('format = "lidarpose/sweep-recording@9"\n')


def text_not_npy(folder: Path) -> None:
    (folder / "range_m.npy").write_text("1 2 3")


def missing_array(folder: Path) -> None:
    (folder / "beam_angle_deg.npy").unlink()


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (cut_short, "range_m.npy"),
        (absurd_shape, "range_m.npy"),
        (pickled, "range_m.npy"),
        (text_not_npy, "range_m.npy"),
        (millimetres, "metres"),
        (integers, "range_m.npy"),
        (other_shape, "beam_angle_deg"),
        (missing_array, "beam_angle_deg.npy"),
        (nan_angle, "entry 2"),
        (backwards, "entry 2"),
        (no_head, "recording.toml"),
        (other_format, "format"),
    ],
)
def test_refuses_damage(recording: SweepRecording, tmp_path: Path, damage: object, named: str) -> None:
    folder = tmp_path / "rec"
    write_recording(folder, recording)
    damage(folder)  # type: ignore[operator]
    with pytest.raises(InputError, match=named):
        read_recording(folder)


def test_refuses_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is missing"):
        read_recording(tmp_path / "none")
