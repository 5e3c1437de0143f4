"""Exports, read back by other programs' readers or by an independent computation, and compared point by point."""

from __future__ import annotations

import ast
import csv
import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import kinpy
import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Calibration, TurntableCalibration, WorldCalibration
from lidarpose.model.camera import Camera
from lidarpose.model.corner_session import CloudFrame
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import read_calibration, write_calibration
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.exports import EXPORT_FORMATS, ExportOptions, FrameNames, export_text, write_export
from lidarpose.storage.exports.common import roll_pitch_yaw

ANGLES_DEG = (0.0, 37.3, -121.9, 725.0)
POINT = np.array([1.234, -0.567, 0.089])
CAMERA = Camera(
    640, 480, np.array([[500.5, 0, 320], [0, 501.5, 240], [0, 0, 1]]), "plumb_bob", np.array([0.1, 0, 0, 0])
)


def turntable(seed: int = 0, covariance: bool = True) -> TurntableCalibration:
    rng = np.random.default_rng(seed)
    motion = TurntableMotion.from_any_frame(Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6)))
    return TurntableCalibration(motion, np.diag(np.arange(1.0, 11.0)) * 1e-8 if covariance else None)


def world(source: CloudFrame = "lidar", scale: float = 1.0, seed: int = 1) -> WorldCalibration:
    pose = Pose.exp(np.random.default_rng(seed).normal(size=6) * 2.0)
    return WorldCalibration(pose, source, scale, np.eye(6) * 1e-6)


def camera_point(calibration: TurntableCalibration, angle_deg: float) -> np.ndarray:
    """The same point through the calibration, by scipy and the definition in docs/conventions.md."""
    motion = calibration.motion
    p = motion.T_turntable_lidar.rotation @ POINT + motion.T_turntable_lidar.translation
    p = Rotation.from_euler("z", angle_deg, degrees=True).apply(p)
    return motion.T_camera_turntable.rotation @ p + motion.T_camera_turntable.translation


def same(found: np.ndarray, wanted: np.ndarray) -> None:
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_urdf_through_a_library_s_forward_kinematics(seed: int) -> None:
    calibration = turntable(seed)
    chain = kinpy.build_chain_from_urdf(export_text(calibration, "urdf").encode())
    assert chain.get_joint_parameter_names() == ["turntable_joint"]
    for angle_deg in ANGLES_DEG:
        frames = chain.forward_kinematics({"turntable_joint": np.deg2rad(angle_deg)})
        T = frames["lidar"].matrix() @ np.append(POINT, 1.0)
        same(T[:3], camera_point(calibration, angle_deg))


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 1.0, 3.0])
def test_roll_pitch_yaw_at_the_gimbal_s_lock(pitch: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        R = Rotation.from_euler("xyz", [rng.uniform(-3, 3), pitch, rng.uniform(-3, 3)]).as_matrix()
        R = R + rng.normal(size=(3, 3)) * 1e-16
        again = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
        np.testing.assert_allclose(again, R, rtol=0.0, atol=2e-15)


def launch_nodes(text: str) -> list[dict[str, object]]:
    """The nodes of a launch file with their literal arguments, without importing it."""
    tree = ast.parse(text)
    constants = {
        target.id: ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }

    def value(node: ast.expr) -> object:
        if isinstance(node, ast.Name):
            return constants[node.id]
        if isinstance(node, ast.Call):  # ParameterValue(text, value_type=str)
            assert getattr(node.func, "id", "") == "ParameterValue"
            return value(node.args[0])
        if isinstance(node, ast.List):
            return [value(item) for item in node.elts]
        if isinstance(node, ast.Dict):
            return {ast.literal_eval(k): value(v) for k, v in zip(node.keys, node.values, strict=True) if k is not None}
        return ast.literal_eval(node)

    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Node"]
    return [{word.arg: value(word.value) for word in call.keywords if word.arg} for call in calls]


def static_transform(text: str) -> tuple[np.ndarray, str, str]:
    (node,) = launch_nodes(text)
    assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
    words = node["arguments"]
    assert isinstance(words, list)
    values = dict(zip(words[::2], words[1::2], strict=True))
    q = [float(values[f"--q{k}"]) for k in "xyzw"]
    p = Rotation.from_quat(q).apply(POINT) + [float(values[f"--{k}"]) for k in "xyz"]
    return p, values["--frame-id"], values["--child-frame-id"]


def test_ros2_turntable_is_a_robot_description_with_the_joint() -> None:
    calibration = turntable(2)
    (node,) = launch_nodes(export_text(calibration, "ros2"))
    assert node["executable"] == "robot_state_publisher"
    assert isinstance(node["parameters"], list)
    (parameters,) = node["parameters"]
    chain = kinpy.build_chain_from_urdf(parameters["robot_description"].encode())
    frames = chain.forward_kinematics({"turntable_joint": 1.0})
    same((frames["lidar"].matrix() @ np.append(POINT, 1.0))[:3], camera_point(calibration, np.rad2deg(1.0)))


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_ros2_at_one_reading_is_a_static_transform(angle_deg: float) -> None:
    calibration = turntable(3)
    text = export_text(calibration, "ros2", ExportOptions(angle_rad=np.deg2rad(angle_deg)))
    p, parent, child = static_transform(text)
    assert (parent, child) == ("camera_optical_frame", "lidar")
    same(p, camera_point(calibration, angle_deg))


@pytest.mark.parametrize("source", ["lidar", "camera"])
def test_world_calibrations(source: CloudFrame, tmp_path: Path) -> None:
    calibration = world(source)
    wanted = calibration.T_world_source @ POINT
    child = {"lidar": "lidar", "camera": "camera_optical_frame"}[source]
    p, *frames = static_transform(export_text(calibration, "ros2"))
    assert frames == ["world", child]
    same(p, wanted)
    chain = kinpy.build_chain_from_urdf(export_text(calibration, "urdf").encode())
    same((chain.forward_kinematics({})[child].matrix() @ np.append(POINT, 1.0))[:3], wanted)
    write_export(tmp_path / "w.yaml", calibration, "opencv")
    storage = cv2.FileStorage(str(tmp_path / "w.yaml"), cv2.FILE_STORAGE_READ)
    same((storage.getNode(f"T_world_{source}").mat() @ np.append(POINT, 1.0))[:3], wanted)
    (row,) = csv_rows(export_text(calibration, "csv"))
    same(row_point(row), wanted)


@pytest.mark.parametrize("suffix", ["yaml", "xml"])
@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_opencv_reads_its_own(tmp_path: Path, suffix: str, angle_deg: float) -> None:
    calibration = turntable(4)
    path = tmp_path / f"c.{suffix}"
    write_export(path, calibration, "opencv", ExportOptions(angle_rad=np.deg2rad(angle_deg), camera=CAMERA))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    R, _ = cv2.Rodrigues(storage.getNode("rvec").mat())
    wanted = camera_point(calibration, angle_deg)
    same(R @ POINT + storage.getNode("tvec").mat().ravel(), wanted)
    same((storage.getNode("T_camera_lidar").mat() @ np.append(POINT, 1.0))[:3], wanted)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", storage.getNode("turntable_angle_rad").real()).as_matrix()
    T = storage.getNode("T_camera_turntable").mat() @ turned @ storage.getNode("T_turntable_lidar").mat()
    same((T @ np.append(POINT, 1.0))[:3], wanted)
    assert storage.getNode("distortion_model").string() == "plumb_bob"
    storage.release()
    np.testing.assert_array_equal(read_camera(path).K, CAMERA.K)


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_the_matrix_as_numpy_reads_it(tmp_path: Path, angle_deg: float) -> None:
    calibration = turntable(8)
    write_export(tmp_path / "T.txt", calibration, "matrix", ExportOptions(angle_rad=np.deg2rad(angle_deg)))
    text = (tmp_path / "T.txt").read_text()
    assert [len(line.split(" ")) for line in text.splitlines()] == [4, 4, 4, 4]
    same((np.loadtxt(tmp_path / "T.txt") @ np.append(POINT, 1.0))[:3], camera_point(calibration, angle_deg))


def test_the_matrix_holds_a_scale(tmp_path: Path) -> None:
    calibration = world(scale=1.01)
    write_export(tmp_path / "T.txt", calibration, "matrix")
    pose = calibration.T_world_source
    wanted = 1.01 * pose.rotation @ POINT + pose.translation
    same((np.loadtxt(tmp_path / "T.txt") @ np.append(POINT, 1.0))[:3], wanted)


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_kalibr_s_camchain(tmp_path: Path, angle_deg: float) -> None:
    calibration = turntable(5)
    path = tmp_path / "camchain.yaml"
    write_export(path, calibration, "kalibr", ExportOptions(angle_rad=np.deg2rad(angle_deg), camera=CAMERA))
    cam0 = YAML(typ="safe", pure=True).load(path.read_text())["cam0"]
    same((np.array(cam0["T_cam_imu"]) @ np.append(POINT, 1.0))[:3], camera_point(calibration, angle_deg))
    again = read_camera(path)
    np.testing.assert_array_equal(again.K, CAMERA.K)
    assert (again.width, again.height) == (640, 480)


def test_kalibr_holds_a_camera_in_the_world() -> None:
    calibration = world("camera")
    cam0 = YAML(typ="safe", pure=True).load(export_text(calibration, "kalibr"))["cam0"]
    p_world = calibration.T_world_source @ POINT
    same((np.array(cam0["T_cam_imu"]) @ np.append(p_world, 1.0))[:3], POINT)
    with pytest.raises(InputError, match="places a LiDAR"):
        export_text(world("lidar"), "kalibr")


def csv_rows(text: str) -> list[dict[str, str]]:
    lines = text.splitlines()
    assert lines[0].startswith("# p_")
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def row_point(row: dict[str, str]) -> np.ndarray:
    q = [float(row[f"q{k}"]) for k in "xyzw"]
    return Rotation.from_quat(q).apply(POINT) + [float(row[f"{k}_m"]) for k in "xyz"]


def test_csv_of_poses_over_angles() -> None:
    calibration = turntable(6)
    rows = csv_rows(export_text(calibration, "csv"))
    assert len(rows) == 360
    for row in rows:
        same(row_point(row), camera_point(calibration, float(row["angle_deg"])))
    uncertain = calibration.uncertain_pose(np.deg2rad(90.0))
    assert uncertain is not None
    sigma = [float(rows[90][f"sigma_{k}_m"]) for k in "xyz"]
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(uncertain.centre_covariance())), rtol=1e-12)
    assert "sigma" not in export_text(turntable(6, covariance=False), "csv").splitlines()[2]


@pytest.mark.parametrize("to", sorted({*EXPORT_FORMATS} - {"matrix"}))
@pytest.mark.parametrize("calibration", [turntable(), world("camera")], ids=["turntable", "world"])
def test_each_file_states_its_direction(to: str, calibration: Calibration) -> None:
    text = export_text(calibration, to)
    comment = [line for line in text.splitlines() if "p_" in line and "=" in line]
    assert comment, text
    parent = "world" if isinstance(calibration, WorldCalibration) and to != "kalibr" else "cam"
    assert f"p_{parent}" in comment[0]


@pytest.mark.parametrize("to", ["ros2", "urdf", "kalibr"])
def test_a_scale_is_never_lost(to: str) -> None:
    with pytest.raises(InputError, match=r"scale 1\.001"):
        export_text(world("camera", scale=1.001), to)
    assert "1.001" in export_text(world(scale=1.001), "csv")


def test_a_calibration_that_holds_only_transforms(tmp_path: Path) -> None:
    calibration = turntable(7)
    motion = calibration.motion
    transforms = [
        {"parent": "camera", "child": "turntable", "matrix": motion.T_camera_turntable.matrix.tolist()},
        {"parent": "turntable", "child": "lidar", "matrix": motion.T_turntable_lidar.matrix.tolist()},
    ]
    document = json.dumps({"format": "lidarpose/calibration@1", "kind": "turntable", "transforms": transforms})
    (tmp_path / "c.json").write_text(document)
    loaded = read_calibration(tmp_path / "c.json")
    for to in EXPORT_FORMATS:
        assert export_text(loaded, to) == export_text(turntable(7, covariance=False), to)
    write_calibration(tmp_path / "again.json", loaded)


def test_frames_have_the_names_that_were_asked_for() -> None:
    options = ExportOptions(names=FrameNames(camera="cam", turntable="table", lidar="sick", world="map"))
    links = [
        link.get("name") for link in ElementTree.fromstring(export_text(turntable(), "urdf", options)).iter("link")
    ]
    assert links == ["cam", "table", "sick"]
    for names in ({"camera": 'a"b'}, {"lidar": "world"}, {"world": ""}, {"lidar": "-->"}):
        with pytest.raises(InputError, match="frame"):
            FrameNames(**names)


def test_what_kalibr_cannot_hold() -> None:
    camera = Camera(640, 480, CAMERA.K, "rational_polynomial", np.full(8, 0.01))
    with pytest.raises(InputError, match="rational"):
        export_text(turntable(), "kalibr", ExportOptions(camera=camera))
    with pytest.raises(InputError, match="--to"):
        export_text(turntable(), "matlab")
