"""Clouds out and in through every format, against other readers and writers, and against damaged files."""

from __future__ import annotations

import base64
import errno
import os
import random
import struct
from pathlib import Path
from typing import Literal

import laspy
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from pye57 import E57

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds import (
    CLOUD_SUFFIXES,
    look_at_points,
    looks_like_millimetres,
    lzf,
    open_cloud_writer,
    pcd,
    read_cloud,
    write_cloud,
)

BINARY = (".ply", ".pcd", ".las", ".laz", ".e57", ".npy")
WRITTEN = tuple(suffix for suffix in CLOUD_SUFFIXES if suffix != ".pts")


def make_cloud(n: int = 500, dtype: type = np.float32, seed: int = 0) -> Cloud:
    rng = np.random.default_rng(seed)
    fields: dict[str, np.ndarray] = {
        "intensity": rng.random(n).astype(np.float32),
        "ring": rng.integers(0, 64, n).astype(np.uint16),
        "time": 1.7e9 + rng.random(n),
        "sigma": rng.random(n).astype(np.float32) * 1e-3,
        "red": rng.integers(0, 256, n).astype(np.uint8),
        "green": rng.integers(0, 256, n).astype(np.uint8),
        "blue": rng.integers(0, 256, n).astype(np.uint8),
        "label": rng.integers(0, 2**32, n).astype(np.uint32),
    }
    return Cloud(rng.normal(scale=3.0, size=(n, 3)).astype(dtype), fields)


def assert_same(found: Cloud, wanted: Cloud, *, metres: float = 0.0, exact_types: bool = True) -> None:
    np.testing.assert_allclose(found.points, wanted.points, rtol=0.0, atol=metres)
    assert set(found.fields) == set(wanted.fields)
    for name, column in wanted.fields.items():
        if exact_types:
            assert found.fields[name].dtype == column.dtype, name
        np.testing.assert_array_equal(found.fields[name].astype(column.dtype), column, err_msg=name)


@pytest.mark.parametrize("suffix", WRITTEN)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_format_keeps_points_and_fields(tmp_path: Path, suffix: str, dtype: type) -> None:
    cloud = make_cloud(dtype=dtype)
    write_cloud(tmp_path / f"a{suffix}", cloud)
    text = suffix in (".xyz", ".txt", ".csv", ".asc")
    tolerance = 0.51e-5 if suffix in (".las", ".laz") else 1e-7 if text else 0.0
    found = read_cloud(tmp_path / f"a{suffix}")
    assert_same(found, cloud, metres=tolerance, exact_types=not text)
    if suffix in (".ply", ".pcd", ".npy", ".e57"):
        assert found.points.dtype == dtype
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


@pytest.mark.parametrize("suffix", WRITTEN)
def test_appended_parts_make_one_cloud(tmp_path: Path, suffix: str) -> None:
    cloud = make_cloud(1000)
    types = {name: column.dtype for name, column in cloud.fields.items()}
    with open_cloud_writer(tmp_path / f"parts{suffix}", fields=types) as writer:
        for start, stop in ((0, 1), (1, 1), (1, 400), (400, 1000)):
            fields = {name: column[start:stop] for name, column in cloud.fields.items()}
            writer.append(Cloud(cloud.points[start:stop], fields))
    write_cloud(tmp_path / f"whole{suffix}", cloud)
    parts, whole = read_cloud(tmp_path / f"parts{suffix}"), read_cloud(tmp_path / f"whole{suffix}")
    assert_same(parts, whole, metres=1.01e-5 if suffix in (".las", ".laz") else 0.0)


@pytest.mark.parametrize("suffix", [s for s in BINARY if s not in (".las", ".laz")])
def test_points_without_return_are_kept(tmp_path: Path, suffix: str) -> None:
    points = np.array([[1.0, 2.0, 3.0], [np.nan, np.nan, np.nan], [4.0, 5.0, 6.0]], dtype=np.float32)
    write_cloud(tmp_path / f"a{suffix}", Cloud(points, {"ring": np.arange(3, dtype=np.uint8)}))
    found = read_cloud(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(found.points, points)
    np.testing.assert_array_equal(found.finite().points, points[[0, 2]])
    np.testing.assert_array_equal(found.finite().fields["ring"], [0, 2])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_refuses_what_it_cannot_hold(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="not finite"):
        write_cloud(tmp_path / f"a{suffix}", Cloud(np.full((2, 3), np.nan)))
    with pytest.raises(InputError, match="km apart"):
        write_cloud(tmp_path / f"a{suffix}", Cloud(np.array([[0.0, 0, 0], [0, 0, 0], [1e6, 0, 0]])))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", BINARY)
def test_a_cloud_without_points_is_a_file_too(tmp_path: Path, suffix: str) -> None:
    write_cloud(tmp_path / f"a{suffix}", Cloud(np.empty((0, 3), dtype=np.float32)))
    assert len(read_cloud(tmp_path / f"a{suffix}")) == 0


@pytest.mark.parametrize("suffix", BINARY)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_cloud(path, make_cloud(300))
    whole = path.read_bytes()
    for part in (0, 1, 10, 100, len(whole) // 2, len(whole) - 5, len(whole) - 1):
        path.write_bytes(whole[:part])
        with pytest.raises(InputError, match=f"a{suffix}"):
            read_cloud(path)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".las"])
def test_bytes_that_no_header_promised_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_cloud(path, make_cloud(300))
    path.write_bytes(path.read_bytes() + b"more")
    if suffix == ".las":  # what follows the points belongs to nobody, and LAS allows it
        assert len(read_cloud(path)) == 300
    else:
        with pytest.raises(InputError, match="more"):
            read_cloud(path)


def test_the_library_of_pcd_leaves_zeros_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_cloud(path, make_cloud(300))
    path.write_bytes(path.read_bytes() + bytes(3928))
    assert len(read_cloud(path)) == 300


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS x y z intensity
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
1 2 3 4
nan nan nan 5
"""


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("COUNT 1 1 1 1", "COUNT 1 1 1 99999999999", "COUNT"),
        ("COUNT 1 1 1 1", "COUNT 1 1 1 4000", "POINTS"),
        ("COUNT 1 1 1 1", "COUNT 1 1 1 0", "COUNT"),
        ("WIDTH 2", "WIDTH 68000000000", "POINTS"),
        ("WIDTH 2", "WIDTH 68000000000000000000", "WIDTH"),
        ("WIDTH 2", "WIDTH -2", "WIDTH"),
        ("WIDTH 2\nHEIGHT 1", "WIDTH 3000000000\nHEIGHT 1", "POINTS"),
        ("POINTS 2", "POINTS 3", "POINTS"),
        ("WIDTH 2\nHEIGHT 1", "HEIGHT 1", "WIDTH"),
        ("FIELDS x y z intensity", "FIELDS x y w intensity", "no z"),
        ("FIELDS x y z intensity", "FIELDS x y z z", "FIELDS"),
        ("FIELDS x y z intensity", "FIELDS x y z", "SIZE"),
        ("SIZE 4 4 4 4", "SIZE 4 4 4 3", "TYPE"),
        ("DATA ascii", "DATA zip", "DATA"),
        ("DATA ascii", "", "DATA"),
        ("nan nan nan 5", "nan nan nan", "point 2"),
        ("1 2 3 4", "1 2 3 4 5", "point 1"),
        ("1 2 3 4", "1 2 drei 4", "point 1"),
        ("1 2 3 4\n", "", "POINTS"),
        ("1 2 3 4\n", "1 2 3 4\n1 2 3 4\n", "POINTS"),
        ("VERSION 0.7", "VERSION 0.7\nWIDTH 2", "WIDTH"),
    ],
)
def test_a_pcd_header_that_the_file_does_not_keep(tmp_path: Path, old: str, new: str, named: str) -> None:
    path = tmp_path / "a.pcd"
    path.write_text(PCD)
    np.testing.assert_array_equal(read_cloud(path).fields["intensity"], [4.0, 5.0])
    path.write_text(PCD.replace(old, new))
    with pytest.raises(InputError, match=named):
        read_cloud(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary_compressed"])
def test_pcd_in_its_other_encodings(tmp_path: Path, encoding: Literal["ascii", "binary_compressed"]) -> None:
    cloud = make_cloud(300)
    cloud = Cloud(cloud.points, {**cloud.fields, "normal": np.eye(3, dtype=np.float32)[np.arange(300) % 3]})
    if encoding == "ascii":  # colours packed into a float do not survive text where they happen to be NaN
        cloud = Cloud(cloud.points, {k: v for k, v in cloud.fields.items() if k not in ("red", "green", "blue")})
    pcd.write_encoded(tmp_path / "a.pcd", cloud, encoding)
    assert_same(read_cloud(tmp_path / "a.pcd"), cloud)


def test_compressed_pcd_that_inflates_is_refused_before_it_is_inflated(tmp_path: Path) -> None:
    header = PCD.split("DATA")[0].replace("WIDTH 2", "WIDTH 33554432").replace("POINTS 2", "POINTS 33554432")
    (tmp_path / "a.pcd").write_bytes(
        header.encode() + b"DATA binary_compressed\n" + struct.pack("<II", 1000, 1 << 29) + bytes(1000)
    )
    with pytest.raises(InputError, match="inflate"):
        read_cloud(tmp_path / "a.pcd")


def test_lzf_agrees_with_the_format_s_own_library() -> None:
    """The bytes were made by liblzf (python-lzf 0.2.6): literals, short and long and overlapping references."""
    random.seed(1)
    plain = bytes(random.choice(b"aaab") for _ in range(200)) + bytes(700)
    plain += bytes(random.randrange(256) for _ in range(40)) + b"metres and radians, metres and seconds"
    theirs = base64.b85decode(
        "1Yu!eVPYTvAO#=?AOxTQU<x1*AOIi)AOau&Km{NYAOS!LAO|1<Kmi~GU;rQnzyd%AU<E)4zyKf=-~<35AV3lz24EII1z-bU5MTu0002N2U<F"
        "_ZKpQ{-AOwH_0%BnR;Qs*N{{Y~k03V1k!m#*wArvb_R#k0@s)D?&t~!-?`b9OQ6woEYOF$d0I>9G$DTumlWpr|7b0A@EWFT^3WNBe;b1Wd>0u"
        "u&vWn*t{WOD"
    )
    assert lzf.decompress(theirs, len(plain)) == plain
    ours = lzf.compress(plain)
    assert len(ours) < 1.1 * len(theirs)
    assert lzf.decompress(ours, len(plain)) == plain
    for part in range(len(theirs)):
        with pytest.raises(ValueError, match="LZF"):
            lzf.decompress(theirs[:part], len(plain))
    with pytest.raises(ValueError, match="before their start"):
        lzf.decompress(b"\x00a\x20\x05", 4)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_agrees_with_plyfile(tmp_path: Path, text: bool, order: str) -> None:
    cloud = make_cloud(100)
    rows = np.empty(100, dtype=[("nx", "i2"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("q", "f8")])
    rows["nx"], rows["q"] = np.arange(100), np.random.default_rng(0).random(100)
    rows["x"], rows["y"], rows["z"] = cloud.points.T
    faces = np.array([([0, 1, 2],), ([3, 4, 5, 6],)], dtype=[("vertex_indices", "O")])
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order=order, comments=["made elsewhere"]).write(str(tmp_path / "theirs.ply"))
    found = read_cloud(tmp_path / "theirs.ply")
    np.testing.assert_allclose(found.points, cloud.points, atol=1e-6 if text else 0.0)
    np.testing.assert_array_equal(found.fields["nx"], rows["nx"])

    write_cloud(tmp_path / "ours.ply", cloud)
    theirs = PlyData.read(str(tmp_path / "ours.ply"))["vertex"]
    np.testing.assert_array_equal(np.column_stack([theirs[k] for k in "xyz"]), cloud.points)
    for name, column in cloud.fields.items():
        np.testing.assert_array_equal(theirs[name], column)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("element vertex 2", "element vertex 99999999999"),
        ("element vertex 2", "element vertex 3"),
        ("element vertex 2", "element vertex 1"),
        ("element vertex 2", "element vertex -1"),
        ("property float z", "property list uchar int z"),
        ("property float z", "property float y"),
        ("property float z", "property text z"),
        ("format ascii 1.0", "format morse 1.0"),
        ("format ascii 1.0\n", ""),
        ("4 5 6", "4 5"),
        ("4 5 6", "4 5 six"),
        ("end_header", "end"),
    ],
)
def test_a_ply_header_that_the_file_does_not_keep(tmp_path: Path, old: str, new: str) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "a.ply").write_text(head + "1 2 3\n4 5 6\n")
    assert len(read_cloud(tmp_path / "a.ply")) == 2
    (tmp_path / "a.ply").write_text((head + "1 2 3\n4 5 6\n").replace(old, new))
    with pytest.raises(InputError, match=r"a\.ply"):
        read_cloud(tmp_path / "a.ply")


def test_las_as_laspy_reads_and_writes_it(tmp_path: Path) -> None:
    cloud = make_cloud(200)
    write_cloud(tmp_path / "ours.laz", cloud)
    theirs = laspy.read(tmp_path / "ours.laz")
    np.testing.assert_allclose(theirs.xyz, cloud.points, atol=0.51e-5)
    np.testing.assert_array_equal(theirs["sigma"], cloud.fields["sigma"])
    np.testing.assert_array_equal(theirs.red, cloud.fields["red"].astype(np.uint16) * 257)

    las = laspy.create(point_format=7, file_version="1.4")
    las.header.scales, las.header.offsets = [1e-3] * 3, [4e5, 5e6, 100.0]
    las.x, las.y, las.z = (cloud.points + [4e5, 5e6, 100.0]).T
    las.intensity = np.arange(200)
    las.gps_time = cloud.fields["time"]
    las.classification = np.full(200, 6)
    las.write(tmp_path / "theirs.las")
    found = read_cloud(tmp_path / "theirs.las")
    np.testing.assert_allclose(found.points - [4e5, 5e6, 100.0], cloud.points, atol=0.51e-3)
    assert set(found.fields) == {"intensity", "time", "classification"}
    np.testing.assert_array_equal(found.fields["intensity"], np.arange(200))
    np.testing.assert_array_equal(found.fields["time"], cloud.fields["time"])


@pytest.mark.parametrize(
    ("offset", "layout", "value", "named"),
    [
        (100, "<I", 2**32 - 1, "number of VLRs"),
        (96, "<I", 2**31, "offset to points"),
        (94, "<H", 100, "header size"),
        (105, "<H", 0, "point record length"),
        (247, "<Q", 2**60, "number of points"),
        (247, "<Q", 10**7, "number of points"),
        (243, "<I", 2**31, "number of EVLRs"),
        (131, "<d", float("nan"), "scale"),
        (0, "<I", 7, "LASF"),
    ],
)
def test_a_las_header_that_the_file_does_not_keep(
    tmp_path: Path, offset: int, layout: str, value: float, named: str
) -> None:
    write_cloud(tmp_path / "a.las", make_cloud(200))
    data = bytearray((tmp_path / "a.las").read_bytes())
    struct.pack_into(layout, data, offset, value)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match=named):
        read_cloud(tmp_path / "a.las")


def test_e57_as_pye57_reads_and_writes_it(tmp_path: Path) -> None:
    cloud = make_cloud(200)
    write_cloud(tmp_path / "ours.e57", Cloud(cloud.points, {"intensity": cloud.fields["intensity"]}))
    theirs = E57(str(tmp_path / "ours.e57"))
    raw = theirs.read_scan_raw(0)
    np.testing.assert_array_equal(raw["cartesianX"], cloud.points[:, 0].astype(np.float64))
    np.testing.assert_array_equal(raw["intensity"], cloud.fields["intensity"])
    theirs.close()

    with E57(str(tmp_path / "theirs.e57"), mode="w") as file:
        data = {f"cartesian{axis}": cloud.points[:, k].astype(np.float64) for k, axis in enumerate("XYZ")}
        half = np.sqrt(0.5)
        file.write_scan_raw(data, rotation=np.array([half, 0, 0, half]), translation=np.array([1.0, 2.0, 3.0]))
        file.write_scan_raw(data)
    found = read_cloud(tmp_path / "theirs.e57")
    turned = np.column_stack([-cloud.points[:, 1] + 1, cloud.points[:, 0] + 2, cloud.points[:, 2] + 3])
    np.testing.assert_allclose(found.points, np.vstack([turned, cloud.points]), atol=1e-6)


def test_npy_of_any_layout(tmp_path: Path) -> None:
    points = make_cloud(50).points
    np.save(tmp_path / "plain.npy", points)
    assert read_cloud(tmp_path / "plain.npy").points.dtype == np.float32
    np.save(tmp_path / "fortran.npy", np.asfortranarray(points))
    np.testing.assert_array_equal(read_cloud(tmp_path / "fortran.npy").points, points)
    np.save(tmp_path / "four.npy", np.column_stack([points, np.arange(50)]))
    np.testing.assert_array_equal(read_cloud(tmp_path / "four.npy").fields["column_4"], np.arange(50))
    np.testing.assert_array_equal(np.load(_written(tmp_path / "ours.npy", Cloud(points))), points)
    for bad in (np.zeros((5, 2)), np.zeros(5), np.array([object()]), np.array(["a", "b", "c"])):
        np.save(tmp_path / "bad.npy", bad)
        with pytest.raises(InputError, match=r"bad\.npy"):
            read_cloud(tmp_path / "bad.npy")


def test_an_npy_header_that_promises_too_much(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((7, 3)))
    data = (tmp_path / "a.npy").read_bytes()
    for shape in (b"(9999999999, 3)", b"(8, 3)", b"(6, 3)", b"(-7, 3)", b"('a', 3)"):
        (tmp_path / "a.npy").write_bytes(data.replace(b"(7, 3), }" + b" " * (len(shape) - 6), shape + b", }"))
        with pytest.raises(InputError, match=r"a\.npy"):
            read_cloud(tmp_path / "a.npy")


def _written(path: Path, cloud: Cloud) -> Path:
    write_cloud(path, cloud)
    return path


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1 2 3\n4 5 6\n", set()),
        ("\n1,2,3,7\n\n4,5,6,8", {"column_4"}),
        ("# x y z sigma\n1 2 3 .1\n4 5 6 .2\n", {"sigma"}),
        ("X;Y;Z;ring\n1;2;3;4\n4;5;6;5\n", {"ring"}),
        ("// made elsewhere\n1\t2\t3\n4\t5\t6\r\n", set()),
        ("x_m,y_m,z_m,intensity\n1,2,3,4\n4,5,6,5\n", {"intensity"}),
        ("\ufeffx,y,z\n1,2,3\n4,5,6\n", set()),
        ("x;y;z\n1,0;2,0;3,0\n4,0;5,0;6,0\n", set()),
        ("1,0 2,0 3,0\n4,0 5,0 6,0\n", set()),
        ("x\ty\tz\tring\n1,0\t2,0\t3,0\t1\n4,0\t5,0\t6,0\t2\n", {"ring"}),
        ("2\n1 2 3 -100\n4 5 6 -200\n", {"column_4"}),
        ("//X,Y,Z,ring\n2\n1,2,3,1\n4,5,6,1\n", {"ring"}),
        ("1 2 3  # first\n4 5 6\n# end\n", set()),
        ('"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","ring"\n1,2,3,0\n4,5,6,0\n', {"ring"}),
        (",x [m],y [m],z (m),\n0,1,2,3,\n1,4,5,6,\n", {"column_1"}),
    ],
)
def test_text_in_the_ways_people_write_it(tmp_path: Path, text: str, names: set[str]) -> None:
    (tmp_path / "a.xyz").write_text(text, encoding="utf-8")
    cloud = read_cloud(tmp_path / "a.xyz")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert set(cloud.fields) == names


@pytest.mark.parametrize(
    "text",
    [
        *("", "hello\n", "1 2\n", "1 2 3\n4 5\n", "1 2 3\n4 5 x\n", "# x y z\n", "\0\0\0", "a b c\n", ","),
        *("3\n1 2 3\n4 5 6\n", "1,234.5 2,345.5 3,456.5\n", "4 5 6\n1,5 2,5 3,0\n", "\ufeff"),
        *(";;\n1 2 3\n", "x_mm,y_mm,z_mm\n1,2,3\n", "1\n2\n3\n", "1.0 2.0 3.0\n\n1,2,3\n", "1,2,3 4\n"),
    ],
)
def test_text_that_is_no_cloud(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.xyz").write_text(text, encoding="utf-8")
    if text == "# x y z\n":
        with pytest.raises(InputError, match="no points"):
            read_cloud(tmp_path / "a.xyz")
        return
    with pytest.raises(InputError, match=r"a\.xyz"):
        read_cloud(tmp_path / "a.xyz")


def test_what_is_no_cloud_at_all(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    for name in ("missing.ply", "folder.ply", "cloud.docx", "cloud"):
        with pytest.raises(InputError, match=name):
            read_cloud(tmp_path / name)
    with pytest.raises(InputError, match="docx"):
        write_cloud(tmp_path / "cloud.docx", Cloud(np.zeros((1, 3))))


def _fail_half_way(path: Path) -> None:
    with open_cloud_writer(path) as writer:
        writer.append(Cloud(np.zeros((3, 3), dtype=np.float32)))
        raise RuntimeError("half-way")


def test_a_writer_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    for suffix in WRITTEN:
        path = tmp_path / f"a{suffix}"
        write_cloud(path, make_cloud(10))
        before = path.read_bytes()
        with pytest.raises(RuntimeError, match="half-way"):
            _fail_half_way(path)
        assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == len(WRITTEN)


@pytest.mark.parametrize("suffix", ["pcd", "ply", "npy"])
def test_room_is_set_aside_for_large_clouds_and_a_full_disk_noticed(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    cloud = Cloud(rng.normal(size=(90_001, 3)).astype(np.float32), {"ring": np.arange(90_001, dtype=np.uint8)})
    path = tmp_path / f"cloud.{suffix}"
    asked: list[int] = []

    def refuse(number: int) -> None:
        def posix_fallocate(file: int, start: int, size: int) -> None:
            asked.append(size)
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "posix_fallocate", posix_fallocate)

    write_cloud(path, cloud)
    usual = path.read_bytes()
    refuse(errno.EOPNOTSUPP)
    write_cloud(path, cloud)
    assert path.read_bytes() == usual
    assert asked == [13 * len(cloud)]
    refuse(errno.ENOSPC)
    with pytest.raises(InputError, match=r"[Nn]o space"):
        write_cloud(path, cloud)
    assert path.read_bytes() == usual
    assert len(list(tmp_path.iterdir())) == 1


def test_millimetres_are_noticed() -> None:
    rng = np.random.default_rng(0)
    room = rng.uniform(-6.0, 6.0, (1000, 3))
    bench = rng.normal(0.0, 0.05, (1000, 3)) + [0.5, 0.0, 0.0]
    for metres in (room, bench):
        assert not looks_like_millimetres(Cloud(metres))
        assert looks_like_millimetres(Cloud(metres * 1000.0))
    assert not looks_like_millimetres(Cloud(np.full((3, 3), np.nan)))


@pytest.mark.parametrize("suffix", WRITTEN)
def test_points_that_are_only_looked_at_are_those_that_are_read(tmp_path: Path, suffix: str) -> None:
    """Of files with further columns and without, one after the other, so that lent memory is used again."""
    for name, cloud in (("a", make_cloud(700)), ("b", Cloud(make_cloud(300).points)), ("c", Cloud(np.zeros((1, 3))))):
        path = tmp_path / f"{name}{suffix}"
        write_cloud(path, cloud)
        np.testing.assert_array_equal(look_at_points(path, np.copy), read_cloud(path).points)


def test_packed_rows_that_lie_otherwise_than_side_by_side_are_looked_at_all_the_same(tmp_path: Path) -> None:
    rows = np.zeros(5, dtype=[("z", "<f4"), ("tag", "u1"), ("y", "<f4"), ("x", "<f4")])
    rows["x"], rows["y"], rows["z"] = np.arange(15.0).reshape(3, 5)
    head = "FIELDS z tag y x\nSIZE 4 1 4 4\nTYPE F U F F\nCOUNT 1 1 1 1\nWIDTH 5\nHEIGHT 1\nPOINTS 5\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    np.testing.assert_array_equal(look_at_points(tmp_path / "a.pcd", np.copy), np.arange(15.0).reshape(3, 5).T)


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_a_file_that_is_cut_off_cannot_be_looked_at(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_cloud(path, make_cloud(100))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"promises|more than"):
        look_at_points(path, len)
    with pytest.raises(InputError, match="cannot be read"):
        look_at_points(tmp_path / f"none{suffix}", len)
