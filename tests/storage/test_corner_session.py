"""Corner sessions on disk: what is written is read again, and what is wrong is named."""

from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.storage.corner_session import read_corner_session, write_corner_session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    session, _ = simulate_corner_session(CornerSceneSpec(places=3, frames=1, hints=True, world_sigma_m=0.001, seed=1))
    write_corner_session(tmp_path / "session", session)
    return tmp_path / "session"


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy"])
def test_a_session_survives_the_disk(tmp_path: Path, suffix: str) -> None:
    session, _ = simulate_corner_session(CornerSceneSpec(places=3, frames=2, hints=True, world_sigma_m=0.001, seed=1))
    write_corner_session(tmp_path / "s", session, suffix=suffix)
    again = read_corner_session(tmp_path / "s")
    assert again.world_sigma_m == pytest.approx(0.001)
    assert again.lidar == session.lidar
    assert again.cloud_frame == "lidar"
    for a, b in zip(session.places, again.places, strict=True):
        assert a.position == b.position
        np.testing.assert_allclose(a.corner_world, b.corner_world, atol=1e-6)
        assert a.near is not None
        assert b.near is not None
        np.testing.assert_allclose(a.near, b.near, atol=1e-3)
        for x, y in zip(a.clouds, b.clouds, strict=True):
            np.testing.assert_array_equal(x.load().points, y.load().points)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("world_x_m", "x_m", "world_x_m"),
        (",near_z_m", "", "near_x_m, near_y_m"),
        ("p01,", "p00,", "'p00' stands in lines 2 and 3"),
        ("clouds/p01/", "clouds/p09/", "no file matches 'clouds/p09/"),
        ("clouds/p01/", "../p01/", "inside the session's folder"),
        ("p02,", "p02,nan", "a finite number"),
    ],
)
def test_wrong_tables_are_named(folder: Path, old: str, new: str, message: str) -> None:
    table = folder / "positions.csv"
    text = table.read_text()
    if new == "p02,nan":
        lines = text.splitlines()
        lines[3] = ",".join(["p02", "nan", *lines[3].split(",")[2:]])
        text = "\n".join(lines)
    elif old == ",near_z_m":
        text = "\n".join(line.rsplit(",", 1)[0] for line in text.splitlines())
    else:
        text = text.replace(old, new)
    table.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_corner_session(folder)
    assert "positions.csv" in str(caught.value)


def test_a_wrong_key_in_the_description_is_named(folder: Path) -> None:
    file = folder / "session.toml"
    file.write_text(file.read_text().replace("world_sigma_m = 0.001", "world_sigma_mm = 1"))
    with pytest.raises(InputError, match="world_sigma_mm"):
        read_corner_session(folder)


def test_a_session_is_not_overwritten(folder: Path) -> None:
    with pytest.raises(InputError, match="already holds a corner session"):
        write_corner_session(folder, read_corner_session(folder))


def test_a_simulation_is_replaced_with_its_truth(folder: Path) -> None:
    session = read_corner_session(folder)
    loaded = [source.load() for place in session.places for source in place.clouds]
    assert loaded
    folder.with_name(folder.name + ".truth.json").write_text("{}")
    write_corner_session(folder, session)
    assert len(read_corner_session(folder).places) == len(session.places)
    assert not folder.with_name(folder.name + ".truth.json").exists()


def test_beams_are_put_to_where_they_cross(tmp_path: Path) -> None:
    spec = CornerSceneSpec(lidar="vlp16", places=3, frames=1, room=True, seed=2)
    session, _ = simulate_corner_session(spec)
    write_corner_session(tmp_path / "s", session)
    file = tmp_path / "s" / "session.toml"
    file.write_text(file.read_text() + "beam_crossing_m = 0.0419\n")
    again = read_corner_session(tmp_path / "s")
    assert again.lidar.beam_crossing_m == pytest.approx(0.0419)
    plain = session.places[0].clouds[0].load().points
    moved = again.places[0].clouds[0].load().points
    np.testing.assert_array_equal(moved[:, :2], plain[:, :2])
    tangent = plain[:, 2] / np.hypot(plain[:, 0], plain[:, 1])
    np.testing.assert_allclose(plain[:, 2] - moved[:, 2], 0.0419 * tangent, atol=2e-6)
    # What is written is as it was read: the key goes.
    write_corner_session(tmp_path / "t", again)
    assert "beam_crossing" not in (tmp_path / "t" / "session.toml").read_text()


def test_beams_are_not_put_to_their_crossing_twice(tmp_path: Path) -> None:
    spec = CornerSceneSpec(lidar="vlp16", places=3, frames=1, room=True, seed=2)
    write_corner_session(tmp_path / "s", simulate_corner_session(spec)[0])
    file = tmp_path / "s" / "session.toml"
    file.write_text(file.read_text() + "beam_crossing_m = 0.0419\n")
    write_corner_session(tmp_path / "t", read_corner_session(tmp_path / "s"))
    file = tmp_path / "t" / "session.toml"
    file.write_text(file.read_text() + "beam_crossing_m = 0.0419\n")
    twice = read_corner_session(tmp_path / "t")
    with pytest.raises(InputError, match=r"cross 41\.9 mm before the axis already"):
        twice.places[0].clouds[0].load()


def test_a_crossing_is_for_clouds_of_a_multi_beam_lidar(folder: Path) -> None:
    file = folder / "session.toml"
    text = file.read_text().replace('cloud_frame = "lidar"', 'cloud_frame = "camera"')
    file.write_text(text + "beam_crossing_m = 0.0419\n")
    with pytest.raises(InputError, match="beam_crossing_m"):
        read_corner_session(folder)


@pytest.mark.parametrize("value", ["41.9", "-0.3", "nan", "inf", '"x"', "true", "[0.04]"])
def test_an_absurd_crossing_is_refused(folder: Path, value: str) -> None:
    file = folder / "session.toml"
    file.write_text(file.read_text() + f"beam_crossing_m = {value}\n")
    with pytest.raises(InputError, match=r"session\.toml: lidar\.beam_crossing_m: "):
        read_corner_session(folder)
