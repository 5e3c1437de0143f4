"""Calibration files: one JSON document, written whole or not at all (docs/formats.md).

A reader needs `format`, `kind` and `transforms` alone, as files of other programs may hold no more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import Calibration, Quality, TurntableCalibration, WorldCalibration
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion
from lidarpose.storage.atomic import write_text
from lidarpose.storage.documents import check_format, read_json
from lidarpose.storage.sections import Within, plainly

if TYPE_CHECKING:
    from lidarpose.storage.calibration_schema import CalibrationFile, TransformEntry

CALIBRATION_FORMAT = "lidarpose/calibration@1"

_Row4 = Annotated[list[float], Within(min_length=4, max_length=4)]


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration file, whole or not at all."""
    import json

    document = calibration_document(calibration)
    write_text(path, json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False) + "\n")


def calibration_document(calibration: Calibration) -> dict[str, Any]:
    """The JSON document of a calibration, keys in the order of docs/formats.md."""
    if isinstance(calibration, TurntableCalibration):
        kind = "turntable"
        both = calibration.transform_covariances() or (None, None)
        transforms = [
            transform_entry("camera", "turntable", calibration.motion.T_camera_turntable, both[0]),
            transform_entry("turntable", "lidar", calibration.motion.T_turntable_lidar, both[1]),
        ]
        scale = 1.0
    else:
        kind = "world"
        transforms = [transform_entry("world", calibration.source, calibration.T_world_source, calibration.covariance)]
        scale = calibration.scale
    document: dict[str, Any] = {
        "format": CALIBRATION_FORMAT,
        "kind": kind,
        "transforms": transforms,
        "scale": float(scale),
    }
    if isinstance(calibration, TurntableCalibration) and _knows_readings(calibration):
        motion = calibration.motion
        document["readings"] = {"scale": motion.reading_scale, "origin_rad": motion.reading_origin_rad}
    if isinstance(calibration, TurntableCalibration) and not calibration.beams.is_none:
        document["beams"] = asdict(calibration.beams)
    if calibration.parameter_covariance is not None:
        document["parameters"] = {
            "names": list(calibration.parameter_names),
            "covariance": calibration.parameter_covariance.tolist(),
        }
    quality = calibration.quality
    if quality is not None:
        document["quality"] = {"verdict": quality.verdict, "reasons": list(quality.reasons), **quality.figures}
    document["provenance"] = dict(calibration.provenance)
    return document


def _knows_readings(calibration: TurntableCalibration) -> bool:
    """Whether a factor on readings is known or feared: its origin is then needed."""
    return calibration.motion.reading_scale != 1.0 or "encoder_scale" in calibration.parameter_names


def transform_entry(parent: str, child: str, pose: Pose, covariance: FloatArray | None = None) -> dict[str, Any]:
    """One entry of `transforms`: ``p_parent = matrix @ p_child``."""
    entry: dict[str, Any] = {
        "parent": parent,
        "child": child,
        "translation_m": pose.translation.tolist(),
        "quaternion_xyzw": pose.quaternion_xyzw.tolist(),
        "matrix": pose.matrix.tolist(),
    }
    if covariance is not None:
        entry["covariance"] = covariance.tolist()
    return entry


def read_calibration(path: Path | str) -> Calibration:
    """Read a calibration of either kind.

    Raises
    ------
    InputError
        If the file is missing or no calibration, a transform is missing, contradicts itself or is no rigid motion, or
        a covariance is not symmetric and positive.
    """
    from lidarpose.storage.calibration_schema import CalibrationFile
    from lidarpose.storage.schemas import parse

    path = Path(path)
    document = read_json(path, "a calibration.json, as `lidarpose calibrate` writes it")
    file = parse(path, CalibrationFile, check_format(path, document, CALIBRATION_FORMAT))
    quality = None
    if file.quality is not None:
        figures = dict(file.quality.model_extra or {})
        quality = Quality(file.quality.verdict, tuple(file.quality.reasons), figures)
    if file.kind == "turntable":
        return _turntable(path, file, quality)
    return _world(path, file, quality)


def read_turntable_calibration(path: Path | str) -> TurntableCalibration:
    """Read a calibration that must be a turntable's. Raises InputError as `read_calibration`, or for another kind."""
    calibration = read_calibration(path)
    if not isinstance(calibration, TurntableCalibration):
        remedy = "A world calibration is one pose for good: its file holds it, and `lidarpose export` writes it."
        raise InputError(path, 'is "world"', field="kind", expected='"turntable"', remedy=remedy)
    return calibration


def read_world_calibration(path: Path | str) -> WorldCalibration:
    """Read a calibration that must be a world one. Raises InputError as `read_calibration`, or for another kind."""
    calibration = read_calibration(path)
    if not isinstance(calibration, WorldCalibration):
        raise InputError(path, 'is "turntable"', field="kind", expected='"world"')
    return calibration


def _turntable(path: Path, file: CalibrationFile, quality: Quality | None) -> TurntableCalibration:
    table, table_covariance = _transform(path, file, "camera", "turntable")
    lidar, lidar_covariance = _transform(path, file, "turntable", "lidar")
    motion = TurntableMotion.from_any_frame(table, lidar)
    if file.readings is not None:
        # A turntable frame with another x reads the same angles: the origin is one of readings.
        motion = replace(motion, reading_scale=file.readings.scale, reading_origin_rad=file.readings.origin_rad)
    beams = BeamCorrection() if file.beams is None else BeamCorrection(**file.beams.model_dump())
    names, covariance = _parameters(path, file)
    if covariance is None or names[: len(PARAMETER_NAMES)] != PARAMETER_NAMES:
        names, covariance = PARAMETER_NAMES, None
        if table_covariance is not None and lidar_covariance is not None:
            covariance = _motion_covariance(table, lidar, table_covariance, lidar_covariance)
    return TurntableCalibration(motion, covariance, names, quality, file.provenance, beams)


def _motion_covariance(table: Pose, lidar: Pose, table_cov: FloatArray, lidar_cov: FloatArray) -> FloatArray:
    """Covariance of the ten parameters from those of two independent transforms, by central differences."""
    nominal = TurntableMotion.from_any_frame(table, lidar)
    h = 1e-6 * max(1.0, nominal.radius_m)
    J = np.zeros((10, 12))
    for k in range(12):
        step = np.zeros(12)
        step[k] = h
        ends = [
            _motion_difference(
                TurntableMotion.from_any_frame(Pose.exp(sign * step[:6]) @ table, Pose.exp(sign * step[6:]) @ lidar),
                nominal,
            )
            for sign in (1.0, -1.0)
        ]
        J[:, k] = (ends[0] - ends[1]) / (2.0 * h)
    both = np.zeros((12, 12))
    both[:6, :6], both[6:, 6:] = table_cov, lidar_cov
    return np.asarray(J @ both @ J.T)


def _motion_difference(motion: TurntableMotion, nominal: TurntableMotion) -> FloatArray:
    from lidarpose.geometry.se3 import log_so3

    turn = log_so3(motion.T_turntable_lidar.rotation @ nominal.T_turntable_lidar.rotation.T)
    table = motion.T_camera_turntable.minus(nominal.T_camera_turntable)
    return np.concatenate([table, [motion.radius_m - nominal.radius_m], turn])


def _world(path: Path, file: CalibrationFile, quality: Quality | None) -> WorldCalibration:
    source: Literal["lidar", "camera"] = "lidar"
    if not any(entry.child == "lidar" for entry in file.transforms):
        source = "camera"
    pose, covariance = _transform(path, file, "world", source)
    names, parameter_covariance = _parameters(path, file)
    return WorldCalibration(pose, source, file.scale, covariance, names, parameter_covariance, quality, file.provenance)


def _transform(path: Path, file: CalibrationFile, parent: str, child: str) -> tuple[Pose, FloatArray | None]:
    entries = [(k, e) for k, e in enumerate(file.transforms) if (e.parent, e.child) == (parent, child)]
    if len(entries) != 1:
        found = ", ".join(f"{e.parent} <- {e.child}" for e in file.transforms)
        problem = f"{parent} <- {child} {'is missing' if not entries else 'stands twice'}"
        raise InputError(path, problem, field="transforms", expected=f"one {parent} <- {child}; found {found}")
    index, entry = entries[0]
    field = f"transforms.{index}"
    try:
        pose = _pose(entry)
    except ValueError as error:
        raise InputError(path, str(error), field=field, expected="a rigid motion") from error
    return pose, _covariance(path, f"{field}.covariance", entry.covariance)


def transform_from(path: Path, entries: list[Any], parent: str, child: str) -> Pose | None:
    """One transform out of a list as calibration files hold it; None if it is not among them.

    Raises
    ------
    InputError
        If an entry is no transform, or no rigid motion.
    """
    for index, document in enumerate(entries):
        entry = plainly(_PlainTransform, document) or _checked_transform(path, document)
        if (entry.parent, entry.child) == (parent, child):
            try:
                return _pose(entry)
            except ValueError as error:
                field = f"transforms.{index}"
                raise InputError(path, str(error), field=field, expected="a rigid motion") from error
    return None


@dataclass(frozen=True)
class _PlainTransform:
    """An entry as this package writes it."""

    parent: str
    child: str
    translation_m: Annotated[list[float], Within(min_length=3, max_length=3)]
    quaternion_xyzw: _Row4
    matrix: Annotated[list[_Row4], Within(min_length=4, max_length=4)]


def _checked_transform(path: Path, document: Any) -> TransformEntry:
    from lidarpose.storage.calibration_schema import TransformEntry
    from lidarpose.storage.schemas import parse

    return parse(path, TransformEntry, document)


def _pose(entry: TransformEntry | _PlainTransform) -> Pose:
    from_matrix = None if entry.matrix is None else Pose.from_matrix(entry.matrix)
    if entry.quaternion_xyzw is None or entry.translation_m is None:
        if from_matrix is None:
            raise ValueError("holds neither a matrix nor translation_m and quaternion_xyzw")
        return from_matrix
    if abs(np.linalg.norm(entry.quaternion_xyzw) - 1.0) > 1e-3:
        raise ValueError("quaternion_xyzw is not of length 1")
    pose = Pose.from_quaternion_xyzw(entry.quaternion_xyzw, entry.translation_m)
    if from_matrix is not None and max(pose.distance(from_matrix)) > 1e-5:
        raise ValueError("matrix and quaternion_xyzw, translation_m are two different motions")
    return pose if from_matrix is None else from_matrix


def _parameters(path: Path, file: CalibrationFile) -> tuple[tuple[str, ...], FloatArray | None]:
    if file.parameters is None:
        return (), None
    names, covariance = tuple(file.parameters.names), file.parameters.covariance
    if len(covariance) != len(names) or any(len(row) != len(names) for row in covariance):
        raise InputError(
            path, "has another size than names", field="parameters.covariance", expected=f"{len(names)} x {len(names)}"
        )
    return names, _covariance(path, "parameters.covariance", covariance)


def _covariance(path: Path, field: str, rows: list[list[float]] | None) -> FloatArray | None:
    if rows is None:
        return None
    covariance = np.array(rows, dtype=np.float64)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    tolerance = 1e-6 * (np.outer(sigma, sigma) + 1e-18)
    if np.any(np.diag(covariance) < 0.0) or np.any(np.abs(covariance - covariance.T) > tolerance):
        raise InputError(path, "is no covariance", field=field, expected="a symmetric matrix, positive on its diagonal")
    scaled = covariance / np.where(np.outer(sigma, sigma) > 0.0, np.outer(sigma, sigma), 1.0)
    if len(covariance) and np.linalg.eigvalsh(scaled)[0] < -1e-6:
        raise InputError(path, "is no covariance", field=field, expected="a matrix without negative eigenvalues")
    return covariance


def figures_for_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Figures as JSON can hold them: numpy numbers and arrays become plain ones, NaN and infinity become null."""
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return figures_for_json(value)
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
