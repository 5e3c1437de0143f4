"""``lidarpose import``: a ROS bag, a LiDAR's packets or a spun LiDAR's cloud as a recording or session."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from lidarpose.cli.options import FiniteFloat, PositiveFloat

if TYPE_CHECKING:
    from lidarpose.model.scan import LidarSpec
    from lidarpose.model.targets import Panel


def import_bag(
    bag: Path,
    out: Path,
    /,
    *,
    as_: Annotated[Literal["recording", "turntable", "corner"] | None, Parameter(name="--as")] = None,
    scan_topic: str | None = None,
    angle_topic: str | None = None,
    joint: str | None = None,
    angle_unit: Literal["deg", "rad"] | None = None,
    image_topic: str | None = None,
    stripe_topic: str | None = None,
    camera_topic: str | None = None,
    camera: Path | None = None,
    panel: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    dwell_s: PositiveFloat = 1.0,
    dwell_tolerance_deg: PositiveFloat = 0.05,
    cloud_topic: str | None = None,
    place: str | None = None,
    world_m: Annotated[tuple[FiniteFloat, FiniteFloat, FiniteFloat] | None, Parameter(negative="")] = None,
    axis_beam_deg: FiniteFloat | None = None,
    half_turn: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    lidar_model: str | None = None,
    range_sigma_m: PositiveFloat | None = None,
) -> None:
    """Make a recording or session of a ROS bag (ROS 1, ROS 2 sqlite3 or MCAP) or of Velodyne packets (.pcap).

    Scans and the turntable's angle make a sweep recording; with images and --panel, a turntable session; clouds are
    added to a corner session as one place. Topics are found by their type. With --axis-beam-deg, the cloud of a spun
    2D LiDAR becomes the recording that it was made of.

    Parameters
    ----------
    bag
        A .bag, .db3 or .mcap file, the folder of a ROS 2 bag, a .pcap file, or a cloud.
    out
        The folder to make.
    as_
        What to make, where the bag holds more than one thing.
    scan_topic
        The topic of the scans (LaserScan, MultiEchoLaserScan).
    angle_topic
        The topic of the turntable's angle (JointState, or a plain number).
    joint
        The turntable's joint, where JointState has several.
    angle_unit
        The unit of an angle topic of plain numbers.
    image_topic
        The topic of the images; of the bright ones, if --stripe-topic names that of the dark ones.
    stripe_topic
        The topic of the dark images with the laser's stripe.
    camera_topic
        The topic of CameraInfo.
    camera
        A camera file instead of CameraInfo.
    panel
        A panel of the board as COLUMNSxROWSxSQUARE_M (inner corners), such as 20x14x0.020. Give it twice.
    dwell_s
        A stop of the turntable lasts at least so long.
    dwell_tolerance_deg
        Readings of a stop lie so close together.
    cloud_topic
        The topic of the clouds (PointCloud2).
    place
        The name of the target's place in a corner session.
    world_m
        The corner's world coordinates at this place.
    axis_beam_deg
        For a cloud that was put together as if the LiDAR sat on the axis and its fan of beams held it: the beam angle
        that is to point along the axis, the cloud's z. `calibrate` then finds how the LiDAR really sat.
    half_turn
        The table of that cloud turned from 0 to 180 degrees, and the fan saw to both sides. Otherwise each beam is
        taken to have been on the side of the cloud's x at reading 0.
    lidar_model
        The LiDAR's name, for the recording.
    range_sigma_m
        The standard deviation of its ranges, if known.
    """
    from lidarpose.cli.console import err
    from lidarpose.cli.console import out as console
    from lidarpose.errors import InputError
    from lidarpose.model.scan import LidarSpec
    from lidarpose.storage.bag_import import ImportOptions
    from lidarpose.storage.bag_import import import_bag as make
    from lidarpose.storage.cloud_import import PlaceOptions
    from lidarpose.storage.clouds import CLOUD_SUFFIXES
    from lidarpose.storage.packets import import_packets

    if axis_beam_deg is not None:
        summary = _import_cloud(bag, out, axis_beam_deg, half_turn, LidarSpec(lidar_model, range_sigma_m))
        console().print(f"{out} (recording): {summary}", markup=False, soft_wrap=True)
        return
    where = PlaceOptions(place, world_m)
    if bag.suffix.lower() in CLOUD_SUFFIXES:
        raise InputError(
            bag,
            "is a cloud",
            expected="a ROS bag or Velodyne packets, or --axis-beam-deg for the cloud of a spun 2D LiDAR",
            remedy="Clouds of a corner session are named in its positions.csv (docs/formats.md).",
        )
    if bag.suffix.lower() in (".pcap", ".pcapng"):
        report = import_packets(bag, out, where)
    else:
        options = ImportOptions(
            kind=as_,
            scan_topic=scan_topic,
            angle_topic=angle_topic,
            joint=joint,
            angle_unit=angle_unit,
            image_topic=image_topic,
            stripe_topic=stripe_topic,
            camera_topic=camera_topic,
            camera=camera,
            cloud_topic=cloud_topic,
            panels=tuple(_panel(text) for text in panel),
            dwell_s=dwell_s,
            dwell_tolerance_deg=dwell_tolerance_deg,
            lidar=LidarSpec(lidar_model, range_sigma_m),
            place=where,
        )
        report = make(bag, out, options)
    for remark in report.remarks:
        err().print(remark, markup=False, soft_wrap=True)
    console().print(f"{out} ({report.kind}): {report.summary}", markup=False, soft_wrap=True)


def _import_cloud(cloud: Path, out: Path, axis_beam_deg: float, half_turn: bool, lidar: LidarSpec) -> str:
    import math
    from dataclasses import replace

    from lidarpose.storage.atomic import require_new_folder
    from lidarpose.storage.clouds import read_cloud
    from lidarpose.storage.recording import write_recording
    from lidarpose.workflows.self_calibration import recording_of_cloud

    require_new_folder(out)
    angle = math.radians(axis_beam_deg)
    recording = recording_of_cloud(read_cloud(cloud), angle, cloud.name, half_turn=half_turn)
    write_recording(out, replace(recording, lidar=lidar))
    return f"{recording.sweeps} sweeps of {recording.beams} beams"


def _panel(text: str) -> Panel:
    from lidarpose.errors import InputError
    from lidarpose.model.targets import Panel

    words = text.lower().split("x")
    try:
        columns, rows, square = int(words[0]), int(words[1]), float(words[2])
    except (ValueError, IndexError):
        columns = rows = 0
        square = 0.0
    if len(words) != 3 or columns < 2 or rows < 2 or not 0.0 < square < 10.0:
        raise InputError("--panel", f"is {text!r}", expected="COLUMNSxROWSxSQUARE_M, such as 20x14x0.020")
    return Panel(columns, rows, square)
