"""Bags made into this package's folders: a sweep recording, a turntable session, or clouds of a corner session."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.camera import Camera
from lidarpose.model.image import GrayImage
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec, Scan
from lidarpose.model.session import DEFAULT_PLACEMENT, TurntablePlace, TurntableSession
from lidarpose.model.targets import Panel
from lidarpose.storage import rosbag
from lidarpose.storage.atomic import require_new_folder
from lidarpose.storage.bag_messages import (
    ScanMessage,
    beam_share,
    camera_of,
    grey_image,
    joint_position,
    point_cloud,
    scan_message,
    stamp_ns,
)
from lidarpose.storage.bag_times import Dwell, Stream, common_times, find_dwells, interpolate
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.cloud_import import PlaceOptions, add_place
from lidarpose.storage.recording import write_recording
from lidarpose.storage.rosbag import Bag, open_bag
from lidarpose.storage.session_writer import write_turntable_session

ImportKind = Literal["recording", "turntable", "corner"]
AngleUnit = Literal["deg", "rad"]

_MAX_ARRAY_BYTES = 1 << 30
_STANDS_DEG = 1e-3
"""A table whose reading changes by less within a sweep stands still."""
_MAX_BOARD_IMAGES = 20
_DARKER = 2.0


@dataclass(frozen=True)
class ImportOptions:
    """What a person says about a bag; topics need a name only where there are several of a kind.

    Attributes
    ----------
    kind
        What to make; None decides by what is there.
    joint
        The turntable's joint in JointState messages with several.
    angle_unit
        Of a topic of plain numbers. None: integers are degrees; floats have to be told.
    stripe_topic
        The topic of the dark images, where bright and dark ones have topics of their own.
    camera
        A camera file, instead of the bag's CameraInfo.
    dwell_s, dwell_tolerance_deg
        A stop of the turntable: readings within the tolerance for so long.
    """

    kind: ImportKind | None = None
    scan_topic: str | None = None
    angle_topic: str | None = None
    joint: str | None = None
    angle_unit: AngleUnit | None = None
    image_topic: str | None = None
    stripe_topic: str | None = None
    camera_topic: str | None = None
    camera: Path | None = None
    cloud_topic: str | None = None
    panels: tuple[Panel, ...] = ()
    dwell_s: float = 1.0
    dwell_tolerance_deg: float = 0.05
    lidar: LidarSpec = field(default_factory=LidarSpec)
    place: PlaceOptions = field(default_factory=PlaceOptions)


@dataclass(frozen=True)
class ImportReport:
    """What was made, in words, and remarks that the user should read."""

    kind: ImportKind
    summary: str
    remarks: tuple[str, ...] = ()


def import_bag(path: Path, out: Path, options: ImportOptions | None = None) -> ImportReport:
    """Make a recording or session of a bag.

    Raises
    ------
    InputError
        If the bag is damaged, lacks what the kind needs, has several topics of a type and none was named, or if time
        stamps cannot be brought together.
    """
    options = options or ImportOptions()
    with open_bag(path) as bag:
        kind = options.kind or _kind(bag, options)
        if kind == "corner":
            topic = _pick(bag, rosbag.CLOUD_TYPES, options.cloud_topic, "--cloud-topic", "clouds")
            clouds = (point_cloud(bag.path, topic, message) for _, _, message in bag.messages([topic]))
            count = add_place(out, clouds, options.place, path)
            return ImportReport("corner", *count)
        require_new_folder(out)
        if kind == "recording":
            return _recording(_read(bag, options, ()), out, options)
        if len(options.panels) != 2:
            expected = "COLUMNSxROWSxSQUARE_M, such as 20x14x0.020"
            raise InputError("--panel", "is needed twice for a turntable session", expected=expected)
        camera = _camera(bag, options)
        return _turntable(_read(bag, options, _image_topics(bag, options)), camera, out, options)


def _kind(bag: Bag, options: ImportOptions) -> ImportKind:
    if bag.of_types(rosbag.SCAN_TYPES):
        pictures = bag.of_types(rosbag.IMAGE_TYPES)
        return "turntable" if pictures and (options.panels or options.stripe_topic) else "recording"
    if bag.of_types(rosbag.CLOUD_TYPES):
        return "corner"
    raise InputError(
        bag.path,
        f"has neither scans nor clouds ({_listed(bag)})",
        expected="LaserScan with an angle topic, or PointCloud2",
    )


def _pick(bag: Bag, types: Iterable[str], given: str | None, option: str, what: str) -> str:
    candidates = [topic.name for topic in bag.of_types(types)]
    if given is not None:
        if given not in candidates:
            raise InputError(bag.path, f"has no {what} on {given}", field=option, expected=_or(candidates, bag))
        return given
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        wanted = ", ".join(sorted({kind.rsplit("/", 1)[-1] for kind in types}))
        raise InputError(bag.path, f"has no topic of {what} ({_listed(bag)})", expected=f"messages of type {wanted}")
    raise InputError(bag.path, f"has {what} on several topics", field=option, expected=_or(candidates, bag))


def _or(candidates: list[str], bag: Bag) -> str:
    return "one of " + ", ".join(candidates) if candidates else f"a topic of that type; the bag has {_listed(bag)}"


def _listed(bag: Bag) -> str:
    topics = [f"{t.name} {t.message_type.rsplit('/', 1)[-1]} x {t.message_count}" for t in bag.topics.values()]
    return ", ".join(topics[:20]) or "no topics"


@dataclass(frozen=True, eq=False)
class _Recorded:
    """What was read of a bag, its times by one clock."""

    bag: Bag
    scans: list[ScanMessage]
    scan_s: FloatArray
    angle_s: FloatArray
    angle_deg: FloatArray
    images: list[BagImage]
    remarks: list[str]


def _read(bag: Bag, options: ImportOptions, image_topics: tuple[str, ...]) -> _Recorded:
    """Scans, readings in degrees and images, in one pass through the bag."""
    scan_topic = _pick(bag, rosbag.SCAN_TYPES, options.scan_topic, "--scan-topic", "scans")
    angle_topic = _pick(bag, rosbag.ANGLE_TYPES, options.angle_topic, "--angle-topic", "the turntable's angle")
    scans: list[ScanMessage] = []
    readings: list[float] = []
    images: list[BagImage] = []
    times: dict[str, tuple[list[int], list[int | None]]] = {}
    sources = {topic: _ImageReader(bag, topic) for topic in image_topics}
    counts = Counter[str]()
    for topic, received, message in bag.messages([scan_topic, angle_topic, *image_topics]):
        if topic == scan_topic:
            scan = scan_message(bag.path, topic, received, message)
            if not len(scan.ranges):
                counts["empty"] += 1
                continue
            scans.append(scan)
        elif topic == angle_topic:
            value = _reading(bag, topic, message, options.joint)
            if value is None:
                continue
            readings.append(value)
        else:
            brightness = float(grey_image(bag.path, topic, message).mean())
            dark = topic == options.stripe_topic
            images.append(BagImage(sources[topic], counts[topic], 0.0, brightness, dark))
            counts[topic] += 1
        entry = times.setdefault(topic, ([], []))
        entry[0].append(received)
        entry[1].append(stamp_ns(message))
    for topic in (scan_topic, angle_topic, *image_topics):
        if topic not in times:
            raise InputError(bag.path, "has no message that could be used", field=topic)
    if not any(np.isfinite(scan.ranges).any() for scan in scans):
        problem = "has no range between range_min and range_max"
        raise InputError(bag.path, problem, field=scan_topic, expected="ranges in metres, as their limits are")
    remarks = [f"{counts['empty']} scans without beams were left out."] if counts["empty"] else []
    remarks += _about_angles(scan_topic, scans)
    angle_deg = _degrees(bag, angle_topic, np.array(readings), options, remarks)
    streams = {topic: Stream.of(*entry) for topic, entry in times.items()}
    seconds, clock_remarks = common_times(str(bag.path), streams, set(image_topics))
    images = [replace(image, time_s=float(seconds[image.source.topic][image.index])) for image in images]
    remarks += clock_remarks
    return _Recorded(bag, scans, seconds[scan_topic], seconds[angle_topic], angle_deg, images, remarks)


def _about_angles(topic: str, scans: list[ScanMessage]) -> list[str]:
    odd = next((scan for scan in scans if scan.contradicts_itself), None)
    if odd is None:
        return []
    first, last, step = (float(np.degrees(a)) for a in (odd.angle_min, odd.angle_max, odd.angle_increment))
    end = first + step * (len(odd.ranges) - 1)
    return [
        f"{topic}: {len(odd.ranges)} beams from {first:.2f} deg in steps of {step:.4f} deg end at {end:.2f} deg, but "
        f"angle_max says {last:.2f}. The steps are taken: see that the scan is neither stretched nor mirrored."
    ]


def _reading(bag: Bag, topic: str, message: Any, joint: str | None) -> float | None:
    if hasattr(message, "position"):
        value = joint_position(bag.path, topic, message, joint)
    else:
        value = float(message.data)
    return value if value is not None and np.isfinite(value) else None


def _degrees(bag: Bag, topic: str, readings: FloatArray, options: ImportOptions, remarks: list[str]) -> FloatArray:
    kind = bag.topics[topic].message_type
    unit = options.angle_unit
    if unit is None and kind in rosbag.JOINT_TYPES:
        unit = "rad"
    if unit is None and "Float" not in kind:
        unit = "deg"
        remarks.append(f"{topic}: whole numbers are taken for degrees (--angle-unit says otherwise).")
    if unit is None:
        raise InputError(
            bag.path,
            f"has readings from {readings.min():g} to {readings.max():g} without a unit",
            field=topic,
            expected="--angle-unit deg or --angle-unit rad",
        )
    return np.rad2deg(readings) if unit == "rad" else readings


def _recording(recorded: _Recorded, out: Path, options: ImportOptions) -> ImportReport:
    bag, scans, remarks = recorded.bag, recorded.scans, recorded.remarks
    columns, beam_angle_rad = _beam_columns(bag, scans)
    shape = (len(scans), len(beam_angle_rad))
    ranges = np.full(shape, np.nan, dtype=np.float32)
    with_intensity = all(scan.intensities is not None for scan in scans)
    intensity = np.full(shape, np.nan, dtype=np.float32) if with_intensity else None
    readings = np.empty(shape)
    dropped = 0
    usual_dt = _usual_beam_dt(scans, recorded.scan_s, remarks)
    for k, scan in enumerate(scans):
        where = columns[scan.geometry]
        dt = usual_dt if scan.beam_dt_s is None else scan.beam_dt_s
        beam_times = recorded.scan_s[k] + dt * np.arange(len(scan.ranges))
        angle, known = interpolate(recorded.angle_s, recorded.angle_deg, beam_times)
        readings[k] = angle[0]
        readings[k, where] = angle
        ranges[k, where] = np.where(known, scan.ranges, np.nan)
        dropped += int(np.count_nonzero(~known & np.isfinite(scan.ranges)))
        if intensity is not None:
            intensity[k, where] = scan.intensities
    if not np.isfinite(ranges).any():
        raise InputError(
            bag.path,
            "no beam lies between two readings of the turntable",
            expected="readings before, during and after the scans",
        )
    if dropped:
        remarks.append(f"{dropped} beams without a reading of the turntable near in time were dropped.")
    stands = bool(np.ptp(readings, axis=1).max() < _STANDS_DEG)
    recording = SweepRecording(
        str(out),
        readings.mean(axis=1) if stands else readings,
        np.rad2deg(beam_angle_rad),
        ranges,
        intensity,
        np.maximum.accumulate(recorded.scan_s),
        options.lidar,
    )
    write_recording(out, recording)
    turn = f"{readings.min():.2f} to {readings.max():.2f} degrees"
    moving = "at stops" if stands else "moving: a reading for each beam"
    summary = f"{len(scans)} sweeps of {len(beam_angle_rad)} beams, turntable {turn} ({moving})"
    return ImportReport("recording", summary, tuple(remarks))


def _beam_columns(bag: Bag, scans: list[ScanMessage]) -> tuple[dict[tuple[float, float, int], slice], FloatArray]:
    """Where each kind of scan has its beams in the recording, and the angles of all of them.

    Some LiDARs change their beams from scan to scan. Each kind gets columns of its own, so that no angle is rounded
    and neighbours stay neighbours; other scans have no return there.
    """
    kinds = [kind for kind, _ in Counter(scan.geometry for scan in scans).most_common()]
    total = sum(count for _, _, count in kinds)
    if total * len(scans) * 8 > _MAX_ARRAY_BYTES and len(kinds) > 1:
        raise InputError(
            bag.path,
            f"has {len(kinds)} different sets of beam angles in {len(scans)} scans",
            expected="scans of few kinds",
            remedy="Let the driver give fixed beam angles (RPLIDAR: angle_compensate), or import a shorter bag.",
        )
    first = {scan.geometry: scan for scan in reversed(scans)}
    columns: dict[tuple[float, float, int], slice] = {}
    angles = []
    start = 0
    for kind in kinds:
        columns[kind] = slice(start, start + kind[2])
        angles.append(first[kind].beam_angle_rad())
        start += kind[2]
    return columns, np.concatenate(angles)


def _usual_beam_dt(scans: list[ScanMessage], scan_times: FloatArray, remarks: list[str]) -> float:
    if all(scan.beam_dt_s is not None for scan in scans):
        return 0.0
    if len(scans) < 2:
        return 0.0
    share = float(np.median([beam_share(scan.angle_increment, len(scan.ranges)) for scan in scans]))
    dt = float(np.median(np.diff(scan_times))) * share
    remarks.append(
        f"Scans do not say how fast they are: {1e6 * dt:.1f} us from beam to beam, by the time between scans."
    )
    return dt


def _turntable(recorded: _Recorded, camera: Camera, out: Path, options: ImportOptions) -> ImportReport:
    bag, remarks = recorded.bag, recorded.remarks
    dwells = find_dwells(
        recorded.angle_s, recorded.angle_deg, tolerance_deg=options.dwell_tolerance_deg, least_s=options.dwell_s
    )
    images = recorded.images if options.stripe_topic is not None else _by_brightness(bag, recorded.images)
    places: list[TurntablePlace] = []
    for dwell in dwells:
        stopped = _scan_of(recorded.scans, recorded.scan_s, dwell)
        if stopped is None:
            continue
        stripe = _nearest([image for image in images if image.dark], 0.5 * (dwell.start_s + dwell.end_s), dwell)
        places.append(
            TurntablePlace(f"{len(places):03d}", float(np.deg2rad(dwell.reading_deg)), stripe, MemoryScan(stopped))
        )
    if not places:
        raise InputError(
            bag.path,
            f"has no stop of the turntable with a whole scan ({len(dwells)} stops of {options.dwell_s:g} s or more)",
            expected="readings that stay the same while the LiDAR scans",
            remedy="--dwell-s and --dwell-tolerance-deg say what a stop is.",
        )
    without = [place.position for place in places if place.stripe_image is None]
    if without:
        remarks.append(f"No dark image at the stops {', '.join(without)}.")
    board = [image for image in images if not image.dark]
    if not board:
        raise InputError(bag.path, "has no bright image of the board", expected="one or more before or between stops")
    chosen = [board[int(k)] for k in np.unique(np.linspace(0, len(board) - 1, _MAX_BOARD_IMAGES).round())]
    for place in places:
        if isinstance(place.stripe_image, BagImage):
            place.stripe_image.source.wanted.add(place.stripe_image.index)
    for image in chosen:
        image.source.wanted.add(image.index)
    session = TurntableSession(
        str(out), camera, options.panels, {DEFAULT_PLACEMENT: tuple(chosen)}, tuple(places), options.lidar
    )
    write_turntable_session(out, session)
    summary = f"{len(places)} places, {len(chosen)} images of the board"
    return ImportReport("turntable", summary, tuple(remarks))


@dataclass(frozen=True)
class MemoryScan:
    """A scan that is in memory already."""

    scan: Scan
    name: str = "scan"

    def load(self) -> Scan:
        return self.scan


class _ImageReader:
    """Images of a topic by index, from any thread; asked for in about ascending order, the bag is read once.

    Wanted images that are passed on the way to another one are kept until they are asked for.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self.bag, self.topic = bag, topic
        self.wanted: set[int] = set()
        self._passed: dict[int, GrayImage] = {}
        self._next = 0
        self._messages: Iterator[tuple[str, int, Any]] = iter(())
        self._lock = Lock()

    def get(self, index: int) -> GrayImage:
        with self._lock:
            if index not in self._passed:
                self._advance(index)
            self.wanted.discard(index)
            return self._passed.pop(index)

    def _advance(self, index: int) -> None:
        if index < self._next or self._next == 0:
            self._messages, self._next = self.bag.messages([self.topic]), 0
        for topic, _, message in self._messages:
            self._next += 1
            if self._next - 1 == index or self._next - 1 in self.wanted:
                self._passed[self._next - 1] = grey_image(self.bag.path, topic, message)
            if self._next > index:
                return
        raise InputError(self.bag.path, f"has no message {index}", field=self.topic)


@dataclass(frozen=True)
class BagImage:
    """An image of a bag, decoded again when it is asked for."""

    source: _ImageReader
    index: int
    time_s: float
    brightness: float
    dark: bool

    @property
    def name(self) -> str:
        return f"{self.source.topic}[{self.index}]"

    def load(self) -> GrayImage:
        return self.source.get(self.index)


def _camera(bag: Bag, options: ImportOptions) -> Camera:
    if options.camera is not None:
        return read_camera(options.camera)
    topic = _pick(
        bag, rosbag.CAMERA_TYPES, options.camera_topic, "--camera-topic", "CameraInfo (or name --camera FILE)"
    )
    for _, _, message in bag.messages([topic]):
        return camera_of(bag.path, topic, message)
    raise InputError(bag.path, "has no message", field=topic, expected="CameraInfo")


def _image_topics(bag: Bag, options: ImportOptions) -> tuple[str, ...]:
    """The topic of all images, or those of the bright and of the dark ones."""
    if options.stripe_topic is None:
        return (_pick(bag, rosbag.IMAGE_TYPES, options.image_topic, "--image-topic", "images"),)
    stripe = _pick(bag, rosbag.IMAGE_TYPES, options.stripe_topic, "--stripe-topic", "images")
    others = [topic.name for topic in bag.of_types(rosbag.IMAGE_TYPES) if topic.name != stripe]
    given = options.image_topic or (others[0] if len(others) == 1 else None)
    return _pick(bag, rosbag.IMAGE_TYPES, given, "--image-topic", "images"), stripe


def _by_brightness(bag: Bag, images: list[BagImage]) -> list[BagImage]:
    """Bright images show the board, dark ones the stripe: two groups with a wide gap between them."""
    levels = np.sort([image.brightness for image in images])
    ratios = (levels[1:] + 1.0) / (levels[:-1] + 1.0)
    if len(levels) < 2 or ratios.max() < _DARKER:
        raise InputError(
            bag.path,
            "has images that are not clearly of two kinds, bright with the board and dark with the stripe",
            expected=f"means of two groups, one twice the other; found {levels.min():.0f} to {levels.max():.0f}",
            remedy="Name the topics by --image-topic and --stripe-topic, or record with the light off and on.",
        )
    gap = int(np.argmax(ratios))
    threshold = 0.5 * (levels[gap] + levels[gap + 1])
    return [replace(image, dark=image.brightness < threshold) for image in images]


def _nearest(images: list[BagImage], time_s: float, dwell: Dwell) -> BagImage | None:
    inside = [image for image in images if dwell.start_s <= image.time_s <= dwell.end_s]
    return min(inside, key=lambda image: abs(image.time_s - time_s), default=None)


def _scan_of(scans: list[ScanMessage], scan_times: FloatArray, dwell: Dwell) -> Scan | None:
    """All sweeps that lie within the stop, one after the other."""
    inside = []
    for scan, start in zip(scans, scan_times, strict=True):
        end = start + (scan.beam_dt_s or 0.0) * len(scan.ranges)
        if dwell.start_s <= start and end <= dwell.end_s:
            inside.append(scan)
    if not inside:
        return None
    intensity = None
    if all(scan.intensities is not None for scan in inside):
        intensity = np.concatenate([scan.intensities for scan in inside if scan.intensities is not None])
    return Scan(
        np.concatenate([scan.beam_angle_rad() for scan in inside]),
        np.concatenate([scan.ranges for scan in inside]),
        intensity,
        np.repeat(np.arange(len(inside)), [len(scan.ranges) for scan in inside]),
    )
