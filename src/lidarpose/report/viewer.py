"""Clouds and rigs for the Rerun viewer: what is drawn as plain layers, and one function that hands them over.

Only `send` and `save` need rerun-sdk (the extra `viewer`); the layers can be looked at without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Calibration, TurntableCalibration, WorldCalibration
from lidarpose.model.cloud import Cloud

MOST_POINTS = 5_000_000
_AXIS_COLOURS = ((224, 72, 62), (53, 168, 83), (63, 127, 224))
_TEAL, _VIOLET = (11, 127, 102), (122, 79, 176)
# From dark blue through green to yellow: evenly rising lightness, legible to the colour-blind.
_RAMP = np.array([[48, 18, 110], [38, 85, 150], [30, 140, 140], [90, 190, 90], [250, 225, 60]], dtype=np.float64)
_COLOURED_BY = ("intensity", "reflectivity", "sigma_m")


@dataclass(frozen=True, eq=False)
class Layer:
    """Points or lines under a name in the viewer's tree.

    Attributes
    ----------
    points : (N, 3) points, or (K, N, 3) strips
        Metres, in the root frame.
    colours : (N, 3) or (3,)
        0 to 255.
    label
        Text at the first point.
    """

    name: str
    kind: Literal["points", "lines"]
    points: FloatArray
    colours: NDArray[np.uint8]
    label: str | None = None


def layers(clouds: Sequence[tuple[str, Cloud]], calibrations: Sequence[tuple[str, Calibration]]) -> list[Layer]:
    """What is drawn.

    The root frame is the world's where a world calibration is given, else the camera's. Clouds are taken to be in the
    root frame.
    """
    root = next((c for _, c in calibrations if isinstance(c, WorldCalibration)), None)
    found = [_cloud_layer(f"clouds/{name}", cloud) for name, cloud in clouds]
    size = _size(found)
    for name, calibration in calibrations:
        if isinstance(calibration, TurntableCalibration):
            T_root_camera = root.T_world_source if root is not None and root.source == "camera" else Pose.identity()
            found += _rig_layers(f"rigs/{name}", calibration, T_root_camera, size)
        else:
            found += _frame_layers(f"rigs/{name}/{calibration.source}", calibration.T_world_source, size)
            found += _frame_layers("world", Pose.identity(), size)
    return found


def looks_along_camera(calibrations: Sequence[tuple[str, Calibration]]) -> bool:
    """Whether the root frame is the camera's (y down) rather than the world's (z up)."""
    return not any(isinstance(c, WorldCalibration) for _, c in calibrations)


def save(path: Path, drawn: Sequence[Layer], *, camera_frame: bool) -> None:
    """Write a recording that Rerun's viewer opens (.rrd). Raises InputError if rerun-sdk is missing."""
    rerun = _rerun()
    stream = rerun.RecordingStream("lidarpose")
    stream.save(str(path))
    _log(rerun, stream, drawn, camera_frame)
    stream.disconnect()


def send(drawn: Sequence[Layer], *, camera_frame: bool) -> None:
    """Open the viewer and show it there. Raises InputError if rerun-sdk is missing, or no viewer can be started."""
    rerun = _rerun()
    stream = rerun.RecordingStream("lidarpose")
    try:
        stream.spawn()
    except (OSError, RuntimeError) as error:
        raise InputError("view", f"the viewer cannot be started: {error}", remedy="Write a file with -o") from error
    _log(rerun, stream, drawn, camera_frame)
    stream.disconnect()


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise InputError(
            "view",
            "needs the viewer, which is not installed",
            expected="the package rerun-sdk",
            remedy="Install it with: pip install 'lidarpose[viewer]'",
        ) from None
    return rerun


def _log(rerun: Any, stream: Any, drawn: Sequence[Layer], camera_frame: bool) -> None:
    view = rerun.ViewCoordinates
    stream.log("/", view.RIGHT_HAND_Y_DOWN if camera_frame else view.RIGHT_HAND_Z_UP, static=True)
    for layer in drawn:
        labels = None if layer.label is None else [layer.label]
        if layer.kind == "points":
            entity = rerun.Points3D(layer.points, colors=layer.colours, labels=labels)
        else:
            entity = rerun.LineStrips3D(list(layer.points), colors=[layer.colours] * len(layer.points), labels=labels)
        # As a list of parts, names from files need no escaping.
        stream.log(layer.name.split("/"), entity, static=True)


def _cloud_layer(name: str, cloud: Cloud) -> Layer:
    whole = cloud.finite()
    step = max(1, -(-len(whole) // MOST_POINTS))
    points = np.asarray(whole.points[::step], dtype=np.float32)
    if all(channel in whole.fields for channel in ("red", "green", "blue")):
        colours = np.stack([_to_bytes(whole.fields[c][::step]) for c in ("red", "green", "blue")], axis=1)
    else:
        field = next((f for f in _COLOURED_BY if f in whole.fields), None)
        # Without any field the distance from the sensor tells most about the shape.
        values = np.linalg.norm(points, axis=1) if field is None else whole.fields[field][::step]
        colours = ramp(values)
    return Layer(name, "points", points, colours)


def ramp(values: ArrayLike) -> NDArray[np.uint8]:
    """Colours (N, 3) of values (N,), stretched between their 2nd and 98th percentile."""
    v = np.asarray(values, dtype=np.float64)
    finite = v[np.isfinite(v)]
    low, high = np.percentile(finite, [2.0, 98.0]) if len(finite) else (0.0, 1.0)
    share = np.clip((np.nan_to_num(v, nan=float(low)) - low) / max(float(high - low), 1e-12), 0.0, 1.0)
    at = share * (len(_RAMP) - 1)
    return np.stack([np.interp(at, np.arange(len(_RAMP)), _RAMP[:, k]) for k in range(3)], axis=1).astype(np.uint8)


def _to_bytes(channel: NDArray[Any]) -> NDArray[np.uint8]:
    """Colour channels are 8 or 16 bits, or 0 to 1."""
    if np.issubdtype(channel.dtype, np.floating):
        return np.asarray(255.0 * np.clip(channel, 0.0, 1.0), dtype=np.uint8)
    wide = channel.dtype.itemsize > 1 and channel.max(initial=0) > 255
    return np.asarray(channel // 256 if wide else channel, dtype=np.uint8)


def _size(drawn: Sequence[Layer]) -> float:
    """A length in metres for axes: a tenth of what the clouds span."""
    spans = [float(np.linalg.norm(np.ptp(layer.points, axis=0))) for layer in drawn if len(layer.points)]
    return 0.1 * max(spans) if spans else 0.2


def _rig_layers(name: str, calibration: TurntableCalibration, T_root_camera: Pose, size: float) -> list[Layer]:
    motion = calibration.motion
    T_root_table = T_root_camera @ motion.T_camera_turntable
    length = min(max(size, 0.5 * motion.radius_m), 0.3)
    turn = np.deg2rad(np.linspace(0.0, 360.0, 181))
    circle = motion.radius_m * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(181)])
    axis = np.array([[0.0, 0.0, -length], [0.0, 0.0, length]])
    return [
        *_frame_layers(f"{name}/camera", T_root_camera, length),
        _line(f"{name}/turntable/axis", T_root_table @ axis, _VIOLET, "turntable's axis"),
        _line(f"{name}/turntable/circle of the LiDAR", T_root_table @ circle, _TEAL),
        *_frame_layers(f"{name}/lidar at 0", T_root_camera @ calibration.pose(0.0), length),
    ]


def _frame_layers(name: str, pose: Pose, length: float) -> list[Layer]:
    """A frame's axes: x red, y green, z blue."""
    label = name.rsplit("/", 1)[-1]
    out = []
    for k, axis in enumerate("xyz"):
        ends = np.stack([pose.translation, pose.translation + length * pose.rotation[:, k]])
        out.append(_line(f"{name}/{axis}", ends, _AXIS_COLOURS[k], label if k == 0 else None))
    return out


def _line(name: str, points: FloatArray, colour: tuple[int, int, int], label: str | None = None) -> Layer:
    return Layer(name, "lines", points[None], np.array(colour, dtype=np.uint8), label)
