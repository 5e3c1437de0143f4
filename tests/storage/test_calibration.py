"""Calibration files: round trips, files of other programs, and contradictions."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Quality, TurntableCalibration, WorldCalibration
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import read_calibration, read_world_calibration, write_calibration


def calibration(seed: int = 0) -> TurntableCalibration:
    rng = np.random.default_rng(seed)
    motion = TurntableMotion.from_any_frame(Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6)))
    root = 1e-3 * rng.normal(size=(10, 10))
    quality = Quality("doubtful", ("little arc",), {"sigma_centre_mm": 0.5})
    return TurntableCalibration(motion, root @ root.T, quality=quality, provenance={"seed": seed})


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def test_what_is_read_prints_short_and_is_read_by_its_name_as_text(tmp_path: Path) -> None:
    write_calibration(tmp_path / "calibration.json", calibration())
    again = read_calibration(str(tmp_path / "calibration.json"))
    assert len(repr(again)) < 1000
    assert "verdict='doubtful'" in repr(again)


def test_a_turntable_calibration_round_trips(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    original = calibration()
    write_calibration(path, original)
    again = read_calibration(path)
    assert isinstance(again, TurntableCalibration)
    first, second = original.uncertain_pose(0.7), again.uncertain_pose(0.7)
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(second.pose.matrix, first.pose.matrix, atol=1e-14)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-9, atol=1e-18)
    assert again.quality is not None
    assert again.quality.verdict == "doubtful"
    assert again.quality.figures["sigma_centre_mm"] == 0.5


def test_transforms_alone_are_enough_in_either_form_and_in_any_turntable_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    T_camera_table, T_table_lidar = Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6))
    document = {
        "format": "lidarpose/calibration@1",
        "kind": "turntable",
        "transforms": [
            {"parent": "camera", "child": "turntable", "matrix": T_camera_table.matrix.tolist()},
            {
                "parent": "turntable",
                "child": "lidar",
                "translation_m": T_table_lidar.translation.tolist(),
                "quaternion_xyzw": T_table_lidar.quaternion_xyzw.tolist(),
            },
        ],
    }
    path = tmp_path / "c.json"
    path.write_text(json.dumps(document))
    loaded = read_calibration(path)
    assert isinstance(loaded, TurntableCalibration)
    expected = T_camera_table @ Pose.rot_z(2.0) @ T_table_lidar
    np.testing.assert_allclose(loaded.pose(2.0).matrix, expected.matrix, atol=1e-12)
    assert loaded.uncertain_pose(2.0) is None


def test_the_covariances_of_the_transforms_stand_in_for_missing_parameters(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    original = calibration(3)
    blocks = np.zeros((10, 10))
    assert original.parameter_covariance is not None
    blocks[:6, :6] = original.parameter_covariance[:6, :6]
    blocks[6:, 6:] = original.parameter_covariance[6:, 6:]
    independent = TurntableCalibration(original.motion, blocks)
    write_calibration(path, independent)
    edit(path, lambda d: d.pop("parameters"))
    loaded = read_calibration(path)
    assert isinstance(loaded, TurntableCalibration)
    first, second = independent.uncertain_pose(1.1), loaded.uncertain_pose(1.1)
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-5, atol=1e-12)


def test_a_world_calibration_round_trips(tmp_path: Path) -> None:
    pose = Pose.exp([1, 2, 3, 0.1, 0.2, 3.0])
    write_calibration(tmp_path / "w.json", WorldCalibration(pose, "camera", 1.01, np.eye(6) * 1e-6))
    again = read_world_calibration(tmp_path / "w.json")
    assert (again.source, again.scale) == ("camera", 1.01)
    np.testing.assert_allclose(again.T_world_source.matrix, pose.matrix, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="lidarpose/calibration@9"), "version 1 only"),
        (lambda d: d.pop("transforms"), "transforms"),
        (lambda d: d["transforms"].pop(0), "camera <- turntable is missing"),
        (lambda d: d["transforms"][0].update(translation_m=[0, 0, 9]), "two different motions"),
        (lambda d: d["transforms"][0].update(quaternion_xyzw=[0, 0, 0, 2]), "length 1"),
        (lambda d: d["transforms"][1].update(matrix=np.diag([1, 1, -1, 1]).tolist()), "transforms.1"),
        (lambda d: d["transforms"][1].update(covariance=(-np.eye(6)).tolist()), "no covariance"),
        (lambda d: d["parameters"]["covariance"].pop(), "another size"),
        (lambda d: d.update(kind="moon"), "kind"),
    ],
)
def test_contradictions_are_named(tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    path = tmp_path / "c.json"
    write_calibration(path, calibration())
    edit(path, change)
    with pytest.raises(InputError, match=message):
        read_calibration(path)


def test_nan_in_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    write_calibration(path, calibration())
    path.write_text(path.read_text().replace('"scale": 1.0', '"scale": NaN'))
    with pytest.raises(InputError, match="NaN is not JSON"):
        read_calibration(path)
