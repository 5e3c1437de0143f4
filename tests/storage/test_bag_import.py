"""Bags of every kind, written by the tests, made into recordings and sessions."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.model.recording import SweepRecording
from lidarpose.model.targets import Panel
from lidarpose.storage.bag_import import ImportOptions, ImportReport, import_bag
from lidarpose.storage.cloud_import import PlaceOptions
from lidarpose.storage.clouds import read_cloud
from lidarpose.storage.recording import read_recording
from lidarpose.storage.session import read_turntable_session
from tests_support import bags

START = 1.7e9
PANELS = (Panel(20, 14, 0.02), Panel(20, 14, 0.02))


def reading(time_s: Any) -> Any:
    """The turntable's reading in degrees: steady, through 360."""
    return 340.0 + 25.0 * (np.asarray(time_s) - START)


def turning(
    kind: str, *, offset: float = 0.0, wrap: bool = False, delay: float = 0.004
) -> list[tuple[str, float, Any]]:
    """Two seconds of a table that never stops: joint states at 100 Hz, scans of 50 beams at 10 Hz.

    `offset`: of the LiDAR's clock. `wrap`: readings start again at 0.
    """
    make = bags.messages(kind)
    entries = []
    for k in range(201):
        t = START + 0.01 * k
        degrees = float(reading(t)) % 360.0 if wrap else float(reading(t))
        entries.append(("/joint_states", t + delay, make.joint(t, np.deg2rad(degrees))))
    for k in range(18):
        t = START + 0.05 + 0.1 * k
        entries.append(("/scan", t + 0.01 + delay, make.scan(t + offset, 1.0 + np.arange(50) * 0.01 + k)))
    return entries


def check_turning(recording: SweepRecording, atol_deg: float) -> None:
    start = START + 0.05 + 0.1 * np.arange(18)
    wanted = reading(start[:, None] + 1e-4 * np.arange(50))
    found = recording.turntable_angle_deg
    turns = np.round((found[0, 0] - wanted[0, 0]) / 360.0) * 360.0
    np.testing.assert_allclose(found - turns, wanted, atol=atol_deg)
    np.testing.assert_allclose(recording.beam_angle_deg, np.rad2deg(-1.0 + 0.01 * np.arange(50)), atol=1e-5)
    np.testing.assert_allclose(recording.range_m, 1.0 + np.arange(50) * 0.01 + np.arange(18)[:, None], rtol=1e-6)
    assert recording.intensity is not None
    np.testing.assert_allclose(recording.intensity, 10.0 * recording.range_m, rtol=1e-6)


def make_recording(
    tmp_path: Path, kind: str, entries: list[Any], options: ImportOptions | None = None
) -> SweepRecording:
    import_bag(bags.write_bag(tmp_path, kind, entries), tmp_path / "out", options)
    return read_recording(tmp_path / "out")


@pytest.mark.parametrize("kind", bags.KINDS)
def test_a_recording_from_every_kind_of_bag(tmp_path: Path, kind: str) -> None:
    recording = make_recording(tmp_path, kind, turning(kind))
    check_turning(recording, 1e-4)
    assert recording.time_s is not None
    np.testing.assert_allclose(recording.time_s, START + 0.05 + 0.1 * np.arange(18), atol=1e-6)


def test_a_single_file_of_a_bag_will_do(tmp_path: Path) -> None:
    for kind, pattern in (("sqlite3", "*.db3"), ("mcap", "*.mcap")):
        (tmp_path / kind).mkdir()
        bag = bags.write_bag(tmp_path / kind, kind, turning(kind))
        import_bag(next(bag.glob(pattern)), tmp_path / kind / "out")
        check_turning(read_recording(tmp_path / kind / "out"), 1e-4)
        (bag / "metadata.yaml").unlink()
        import_bag(bag, tmp_path / kind / "again")
        check_turning(read_recording(tmp_path / kind / "again"), 1e-4)


def test_readings_that_pass_from_359_to_0(tmp_path: Path) -> None:
    check_turning(make_recording(tmp_path, "mcap", turning("mcap", wrap=True)), 1e-4)


def test_a_lidar_with_a_clock_of_its_own(tmp_path: Path) -> None:
    bag = bags.write_bag(tmp_path, "sqlite3", turning("sqlite3", offset=-START + 77.0))
    report = import_bag(bag, tmp_path / "out")
    # Receptions come 10 ms later after the scans than after the readings: 0.25 degrees at 25 degrees a second.
    check_turning(read_recording(tmp_path / "out"), 0.26)
    assert any("another clock" in remark for remark in report.remarks)


def test_plain_numbers_have_no_stamps(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [entry for entry in turning("mcap") if entry[0] == "/scan"]
    entries += [
        ("/angle", START + 0.01 * k, make.number("Float64", float(reading(START + 0.01 * k)))) for k in range(201)
    ]
    bag = bags.write_bag(tmp_path, "mcap", entries)
    with pytest.raises(InputError, match="--angle-unit"):
        import_bag(bag, tmp_path / "out")
    report = import_bag(bag, tmp_path / "out", ImportOptions(angle_unit="deg"))
    check_turning(read_recording(tmp_path / "out"), 0.36)
    assert any("has no stamps" in remark for remark in report.remarks)
    radians = import_bag(bag, tmp_path / "rad", ImportOptions(angle_unit="rad"))
    assert "degrees" in radians.summary


def test_a_wandering_clock_is_refused(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [entry for entry in turning("mcap") if entry[0] != "/scan"]
    for k in range(60):
        t = START + 0.03 * k
        entries.append(("/scan", t, make.scan(100.0 + 0.03 * k + (1.0 if k > 30 else 0.0), np.ones(50))))
    with pytest.raises(InputError, match="clock"):
        import_bag(bags.write_bag(tmp_path, "mcap", entries), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_stamps_that_run_backwards_are_refused(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [*turning("mcap"), ("/scan", START + 1.95, make.scan(START + 0.5, np.ones(50)))]
    with pytest.raises(InputError, match=r"/scan: the stamps run backwards at message 19"):
        import_bag(bags.write_bag(tmp_path, "mcap", entries), tmp_path / "out")


def test_topics_that_were_not_recorded_together_are_refused(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [("/joint_states", START + k, make.joint(START + k, 0.0)) for k in range(10)]
    entries += [("/scan", START + 100 + k, make.scan(START + 100 + k, np.ones(50))) for k in range(10)]
    with pytest.raises(InputError, match="cannot be brought together"):
        import_bag(bags.write_bag(tmp_path, "mcap", entries), tmp_path / "out")


def test_beams_outside_the_readings_and_in_their_gaps_are_dropped(tmp_path: Path) -> None:
    lost = {f"{START + 0.01 * k:.3f}" for k in range(60, 100)}
    entries = [
        entry
        for entry in turning("mcap", delay=0.0)
        if entry[0] == "/scan" or (f"{entry[1]:.3f}" not in lost and entry[1] < START + 1.5)
    ]
    bag = bags.write_bag(tmp_path, "mcap", entries)
    report = import_bag(bag, tmp_path / "out")
    there = read_recording(tmp_path / "out").has_return().any(axis=1)
    start = 0.05 + 0.1 * np.arange(18)
    np.testing.assert_array_equal(there, ((start < 0.59) | (start >= 1.0)) & (start < 1.495))
    assert any("dropped" in remark for remark in report.remarks)


def test_a_table_that_stands_has_one_reading_a_sweep(tmp_path: Path) -> None:
    make = bags.messages("ros1")
    entries = [("/j", START + 0.01 * k, make.joint(START + 0.01 * k, 0.5)) for k in range(100)]
    entries += [("/scan", START + 0.2, make.scan(START + 0.2, np.ones(50)))]
    recording = make_recording(tmp_path, "ros1", entries)
    np.testing.assert_allclose(recording.turntable_angle_deg, [np.rad2deg(0.5)])


def test_scans_with_changing_beams_keep_their_angles(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [entry for entry in turning("mcap") if entry[0] != "/scan"]
    entries += [("/scan", START + 0.1 * k, make.scan(START + 0.1 * k, np.full(50 + k % 2, 2.0))) for k in range(1, 9)]
    entries += [("/scan", START + 0.95, make.scan(START + 0.95, np.zeros(0), angle_increment=np.inf))]
    recording = make_recording(tmp_path, "mcap", entries)
    assert recording.beams == 101
    for k in range(8):
        angles = recording.beam_angle_deg[recording.has_return()[k]]
        np.testing.assert_allclose(angles, np.rad2deg(-1.0 + 0.01 * np.arange(50 + (k + 1) % 2)), atol=1e-5)


def test_the_strongest_echo_and_no_range_that_the_sensor_calls_invalid(tmp_path: Path) -> None:
    make = bags.messages("sqlite3")
    entries = [("/j", START + 0.01 * k, make.joint(START + 0.01 * k, 0.5)) for k in range(100)]
    echoes = [[1.0, 2.0], [3.0], [], [0.05], [np.inf], [np.inf, 4.0], [5.0, np.nan], [6.0, 40.0]]
    strengths = [[5.0, 9.0], [1.0], [], [1.0], [1.0], [9.0, 1.0], [1.0, np.nan], [1.0, 9.0]]
    entries.append(("/multi", START + 0.5, make.multi_echo(START + 0.5, echoes, strengths)))
    recording = make_recording(tmp_path, "sqlite3", entries)
    wanted = [[2.0, 3.0, np.nan, np.nan, np.nan, 4.0, 5.0, 6.0]]
    np.testing.assert_array_equal(recording.range_m, np.array(wanted, dtype=np.float32))


def scans_with(**values: Any) -> list[Any]:
    """Scans of 271 beams 0.01 rad apart while the table turns by 0.1 rad a second, for 1.2 s."""
    make = bags.messages("mcap")
    entries = [("/j", START + t, make.joint(START + t, 0.1 * t)) for t in np.arange(-0.1, 1.4, 0.01)]
    ranges = values.pop("ranges", np.full(271, 2.0))
    return entries + [("/s", START + t, make.scan(START + t, ranges, **values)) for t in np.arange(12) * 0.1]


@pytest.mark.parametrize("scan_time", [0.1, 0.0])
def test_a_fan_is_seen_in_its_share_of_the_mirror_s_turn(tmp_path: Path, scan_time: float) -> None:
    recording = make_recording(tmp_path, "mcap", scans_with(time_increment=0.0, scan_time=scan_time))
    turned = np.ptp(np.radians(recording.turntable_angle_deg), axis=1)
    np.testing.assert_allclose(turned[:-1], 0.1 * 0.1 * 2.7 / (2.0 * np.pi), rtol=1e-3)


@pytest.mark.parametrize(
    ("angles", "told"),
    [
        ({"angle_min": 1.0, "angle_increment": -0.01, "angle_max": -1.7}, False),
        ({"angle_max": -1.0 + 0.01 * 271}, False),
        ({"angle_min": -np.pi, "angle_increment": 2.0 * np.pi / 271, "angle_max": -np.pi}, False),
        ({"angle_min": 1.0, "angle_max": -1.7}, True),
        ({"angle_max": -1.0 + 0.02 * 270}, True),
    ],
)
def test_beams_go_by_their_steps_and_a_contradicting_end_is_told(
    tmp_path: Path, angles: dict[str, float], told: bool
) -> None:
    report = import_bag(bags.write_bag(tmp_path, "mcap", scans_with(**angles)), tmp_path / "out")
    assert any("angle_max" in remark for remark in report.remarks) == told
    wanted = angles.get("angle_min", -1.0) + angles.get("angle_increment", 0.01) * np.arange(271)
    np.testing.assert_allclose(read_recording(tmp_path / "out").beam_angle_rad, wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"angle_min": -135.0, "angle_max": 135.0, "angle_increment": 1.0}, "radians"),
        ({"ranges": np.full(271, 2000.0)}, "range_min and range_max"),
        ({"ranges": np.full(271, 5000.0), "range_max": 30000.0}, "millimetres"),
    ],
)
def test_scans_in_other_units_are_refused(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    bag = bags.write_bag(tmp_path, "mcap", scans_with(**values))
    with pytest.raises(InputError, match=message):
        import_bag(bag, tmp_path / "out")


def test_topics_are_named_where_there_are_several(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    entries = [*turning("mcap"), ("/scan_b", START + 1, make.scan(START + 1, np.ones(50)))]
    entries += [("/arm", START + 1, make.joint(START + 1, 0.1, 0.2, names=("a", "b")))]
    bag = bags.write_bag(tmp_path, "mcap", entries)
    with pytest.raises(InputError, match=r"--scan-topic: .*one of /scan, /scan_b"):
        import_bag(bag, tmp_path / "out")
    with pytest.raises(InputError, match=r"--angle-topic: .*/joint_states"):
        import_bag(bag, tmp_path / "out", ImportOptions(scan_topic="/scan"))
    with pytest.raises(InputError, match="has no scans on /nope"):
        import_bag(bag, tmp_path / "out", ImportOptions(scan_topic="/nope"))
    options = ImportOptions(scan_topic="/scan", angle_topic="/joint_states")
    import_bag(bag, tmp_path / "out", options)
    with pytest.raises(InputError, match="exists already"):
        import_bag(bag, tmp_path / "out", options)
    with pytest.raises(InputError, match="several joints: a, b"):
        import_bag(bag, tmp_path / "b", ImportOptions(scan_topic="/scan_b", angle_topic="/arm"))


def stops(kind: str, *, encoding: str = "mono8", stamped: bool = True) -> list[tuple[str, float, Any]]:
    """A turntable session: board lit for a second, then three stops of two seconds with stripes in the dark."""
    make = bags.messages(kind)
    rng = np.random.default_rng(0)
    K = np.array([[500.0, 0, 32], [0, 500.0, 24], [0, 0, 1]])
    entries: list[tuple[str, float, Any]] = [("/camera_info", START, make.camera(64, 48, K, np.zeros(5)))]

    def image(t: float, level: int, topic: str = "/image") -> tuple[str, float, Any]:
        grey = rng.integers(level, level + 20, (48, 64)).astype(np.uint8)
        if encoding == "png":
            return topic, t + 0.01, make.compressed(t, cv2.imencode(".png", grey)[1].tobytes())
        if encoding == "rgb8":
            return topic, t + 0.01, make.image(t, np.dstack([grey] * 3), "rgb8")
        if encoding == "mono16":
            return topic, t + 0.01, make.image(t, grey.astype(np.uint16) * 256, "mono16")
        return topic, t + 0.01, make.image(t, grey, "mono8")

    entries += [image(START + 0.2 * k, 150) for k in range(1, 4)]
    for k in range(1000):
        t = START + 0.01 * k
        stop = min(int((t - START) / 3.0), 2)
        angle = 10.0 * stop + (10.0 * (t - START - 3.0 * stop - 2.0) if t - START - 3.0 * stop > 2.0 else 0.0)
        entries.append(("/joint_states", t, make.joint(t if stamped else None, np.deg2rad(angle))))
    for k in range(95):
        t = START + 0.1 * k
        entries.append(("/scan", t + 0.02, make.scan(t, np.full(50, 1.0 + 0.01 * int(0.1 * k / 3.0)))))
    for stop in range(3):
        entries.append(image(START + 3.0 * stop + 1.2, 5))
        entries.append(image(START + 3.0 * stop + 1.9, 5))
    return entries


@pytest.mark.parametrize(
    ("kind", "encoding"), [("ros1", "mono8"), ("mcap-zstd", "rgb8"), ("sqlite3", "mono16"), ("mcap", "png")]
)
def test_a_turntable_session(tmp_path: Path, kind: str, encoding: str) -> None:
    bag = bags.write_bag(tmp_path, kind, stops(kind, encoding=encoding))
    report = import_bag(bag, tmp_path / "out", ImportOptions(panels=PANELS))
    assert report.summary.startswith("3 places, 3 images")
    session = read_turntable_session(tmp_path / "out")
    assert [np.rad2deg(place.turntable_angle_rad) for place in session.places] == pytest.approx(
        [0.0, 10.0, 20.0], abs=0.06
    )
    assert session.panels == PANELS
    for k, place in enumerate(session.places):
        scan = place.scan.load()
        np.testing.assert_allclose(scan.range_m, 1.0 + 0.01 * k, rtol=1e-6)
        assert scan.sweep is not None
        assert len(np.unique(scan.sweep)) >= 15
        assert place.stripe_image is not None
        stripe = place.stripe_image.load()
        assert stripe.dtype == (np.uint16 if encoding == "mono16" else np.uint8)
        assert stripe.mean() < (256 if encoding == "mono16" else 1) * 26
    (images,) = session.board_images.values()
    assert all(image.load().mean() > 150 for image in images)


def test_a_session_whose_scans_have_another_clock(tmp_path: Path) -> None:
    entries = stops("mcap", stamped=False)
    bag = bags.write_bag(tmp_path, "mcap", entries)
    import_bag(bag, tmp_path / "out", ImportOptions(panels=PANELS))
    assert len(read_turntable_session(tmp_path / "out").places) == 3


def test_images_of_one_kind_are_refused(tmp_path: Path) -> None:
    bright = [entry for entry in stops("mcap") if entry[0] != "/image" or entry[1] < START + 1]
    with pytest.raises(InputError, match="two kinds"):
        import_bag(bags.write_bag(tmp_path, "mcap", bright), tmp_path / "out", ImportOptions(panels=PANELS))


def test_what_a_session_needs(tmp_path: Path) -> None:
    bag = bags.write_bag(tmp_path, "mcap", [entry for entry in stops("mcap") if entry[0] != "/camera_info"])
    with pytest.raises(InputError, match="--panel"):
        import_bag(bag, tmp_path / "out", ImportOptions(kind="turntable"))
    with pytest.raises(InputError, match="--camera"):
        import_bag(bag, tmp_path / "out", ImportOptions(panels=PANELS))
    assert not (tmp_path / "out").exists()


ROW = np.dtype({"names": ["x", "y", "z", "intensity", "ring", "time"], "formats": ["<f4"] * 4 + ["<u2", "<f8"],
                "offsets": [0, 4, 8, 16, 20, 24], "itemsize": 32})  # fmt: skip


def cloud_rows(n: int = 100, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(1)
    rows = np.zeros(n, dtype=ROW)
    for name in ROW.names or ():
        rows[name] = rng.uniform(1.0, 5.0, n) * (scale if name in "xyz" else 1.0)
    rows["x"][3] = np.nan
    return rows


@pytest.mark.parametrize("kind", ["ros1-lz4", "sqlite3", "mcap-zstd"])
def test_clouds_of_a_place(tmp_path: Path, kind: str) -> None:
    make, rows = bags.messages(kind), cloud_rows()
    entries = [("/points", START + k, make.cloud(START + k, rows)) for k in range(3)]
    bag = bags.write_bag(tmp_path, kind, entries)
    report = import_bag(bag, tmp_path / "out", ImportOptions(place=PlaceOptions(corner_world_m=(1.0, 2.0, 3.0))))
    assert report == ImportReport("corner", "place p00: 3 clouds, 300 points", ())
    second = import_bag(bag, tmp_path / "out")
    assert "world coordinates of p01" in second.remarks[0]
    lines = (tmp_path / "out/positions.csv").read_text().splitlines()
    assert lines[1:] == ["p00,1.0,2.0,3.0,clouds/p00/*.pcd", "p01,,,,clouds/p01/*.pcd"]
    cloud = read_cloud(tmp_path / "out/clouds/p00/002.pcd")
    np.testing.assert_array_equal(cloud.points, np.column_stack([rows[k] for k in "xyz"]))
    for name in ("intensity", "ring", "time"):
        np.testing.assert_array_equal(cloud.fields[name], rows[name])


@pytest.mark.parametrize(
    "wrong",
    [
        {"point_step": 28},
        {"row_step": 10},
        {"width": 101},
        {"data": np.zeros(10, dtype=np.uint8)},
        {"height": 2**31, "width": 2**31},
        {"point_step": 0},
    ],
)
def test_clouds_that_contradict_themselves(tmp_path: Path, wrong: dict[str, Any]) -> None:
    make = bags.messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", [("/points", START, make.cloud(START, cloud_rows(), **wrong))])
    with pytest.raises(InputError, match="/points"):
        import_bag(bag, tmp_path / "out")
    assert not (tmp_path / "out/clouds/p00").exists()


def test_clouds_in_millimetres_are_refused(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", [("/points", START, make.cloud(START, cloud_rows(scale=1000.0)))])
    with pytest.raises(InputError, match="millimetres"):
        import_bag(bag, tmp_path / "out")


def test_a_bag_without_anything_of_use(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", [("/n", START, make.number("Int32", 3))])
    with pytest.raises(InputError, match=r"neither scans nor clouds \(/n Int32 x 1\)"):
        import_bag(bag, tmp_path / "out")


def zeros_bag(folder: Path, kind: str, size: int) -> Path:
    make = bags.messages(kind)
    black = make.image(START, np.zeros((size >> 12, 4096), dtype=np.uint8), "mono8")
    scan = make.scan(START, np.ones(5))
    return bags.write_bag(
        folder, kind, [("/image", START, black), ("/scan", START, scan), ("/a", START, make.joint(START, 0.0))]
    )


@pytest.mark.parametrize("kind", ["mcap-zstd", "sqlite3-zstd-message", "sqlite3-zstd-file", "ros1-bz2"])
def test_a_small_bag_that_inflates_is_refused(tmp_path: Path, kind: str) -> None:
    bag = zeros_bag(tmp_path, kind, 96 << 20)
    size = sum(f.stat().st_size for f in ([bag] if bag.is_file() else bag.iterdir()))
    assert size < 200_000
    with pytest.raises(InputError, match="inflates"):
        import_bag(bag, tmp_path / "out", ImportOptions(kind="turntable", panels=PANELS, camera=_camera_file(tmp_path)))


def _camera_file(folder: Path) -> Path:
    from lidarpose.model.camera import Camera
    from lidarpose.storage.camera_info import write_camera_info

    write_camera_info(folder / "camera.yaml", Camera(64, 48, np.array([[500.0, 0, 32], [0, 500, 24], [0, 0, 1]])))
    return folder / "camera.yaml"


@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4", "sqlite3", "mcap", "mcap-zstd"])
def test_a_bag_cut_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    bag = bags.write_bag(tmp_path, kind, turning(kind))
    file = bag if bag.is_file() else next(f for f in bag.iterdir() if f.suffix in (".db3", ".mcap"))
    whole = file.read_bytes()
    for part in (0, 10, 1000, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:part])
        if kind == "sqlite3" and part == len(whole) - 1:
            continue  # SQLite's last page may be empty; the database then is whole
        with pytest.raises(InputError, match="bag"):
            import_bag(bag, tmp_path / "out")


def test_what_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "text.bag").write_text("hello")
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.zip").write_bytes(b"PK")
    (tmp_path / "a?b.db3").write_bytes(b"SQLite format 3\0")
    (tmp_path / "big").mkdir()
    (tmp_path / "big/metadata.yaml").write_bytes(b"a" * (2 << 20))
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil/metadata.yaml").write_text("!!python/object/apply:os.system ['touch /tmp/evil']")
    for name in ("text.bag", "folder", "a.zip", "missing.bag", "a?b.db3", "big", "evil"):
        with pytest.raises(InputError, match=name.replace("?", r"\?")):
            import_bag(tmp_path / name, tmp_path / "out")


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
@pytest.mark.parametrize("count", ["^", "'=0'", "[]", "{a: 1}", "1e999"])
def test_words_for_counts_are_refused(tmp_path: Path, kind: str, count: str) -> None:
    bag = bags.write_bag(tmp_path, kind, turning(kind))
    metadata = bag / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(re.sub(r"(- message_count:) \d+", rf"\1 {count}", text))
    assert metadata.read_text() != text
    with pytest.raises(InputError, match=re.escape(str(bag))):
        import_bag(bag, tmp_path / "out")


def test_a_forged_message_length_is_refused(tmp_path: Path) -> None:
    make = bags.messages("mcap")
    bag = bags.write_bag(tmp_path, "mcap", [("/points", START, make.cloud(START, cloud_rows()))])
    file = next(bag.glob("*.mcap"))
    data = bytearray(file.read_bytes())
    where = data.index(struct.pack("<I", 3200))  # the length of the array of points
    data[where : where + 4] = struct.pack("<I", 2**32 - 1)
    file.write_bytes(data)
    with pytest.raises(InputError, match="bag"):
        import_bag(bag, tmp_path / "out")
