"""``lidarpose view``: clouds and rigs in the Rerun viewer, or as a recording for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lidarpose.errors import InputError

if TYPE_CHECKING:
    from lidarpose.model.calibration import Calibration
    from lidarpose.model.cloud import Cloud


def view(
    *inputs: Path,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
) -> None:
    """Look at clouds and calibrated rigs in 3D. Needs the extra `viewer`: pip install 'lidarpose[viewer]'.

    Parameters
    ----------
    inputs
        Clouds (.ply .pcd .las .laz .e57 .npy .xyz) and calibration files (.json). With a world calibration everything
        is shown in the world's frame, without one in the camera's; clouds are taken to be in that frame.
    output
        Write a recording (.rrd) to this file instead of opening the viewer. Whoever gets it opens it with
        `rerun FILE`, or in a browser at any Rerun viewer.
    """
    from lidarpose.report.viewer import layers, looks_along_camera, save, send
    from lidarpose.storage.atomic import replacing

    if not inputs:
        raise InputError("view", "was given nothing to show", expected="clouds or calibration files")
    if output is not None and output.suffix != ".rrd":
        raise InputError(output, "is no recording for the viewer", expected="a name that ends in .rrd")
    clouds, calibrations = _read(inputs)
    drawn = layers(clouds, calibrations)
    camera_frame = looks_along_camera(calibrations)
    if output is None:
        send(drawn, camera_frame=camera_frame)
        return
    with replacing(output) as temporary:
        save(temporary, drawn, camera_frame=camera_frame)
    from lidarpose.cli.console import out

    out().print(f"written: {output}", markup=False, soft_wrap=True)


def _read(inputs: tuple[Path, ...]) -> tuple[list[tuple[str, Cloud]], list[tuple[str, Calibration]]]:
    from lidarpose.storage.calibration import read_calibration
    from lidarpose.storage.clouds import read_cloud

    clouds: list[tuple[str, Cloud]] = []
    calibrations: list[tuple[str, Calibration]] = []
    for k, path in enumerate(inputs):
        # Two files may share a name; the viewer's tree must not.
        name = f"{k + 1} {path.stem}"
        if path.suffix.lower() == ".json":
            calibrations.append((name, read_calibration(path)))
        else:
            clouds.append((name, read_cloud(path)))
    return clouds, calibrations
