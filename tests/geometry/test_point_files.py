# SPDX-License-Identifier: MIT
"""Points as PLY, PCD, LAS and LAZ, read back."""

import struct
import sys
from pathlib import Path

import laspy
import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion import Mesh, MissingDependency
from tsfusion.core.errors import OutputError
from tsfusion.geometry import point_files
from tsfusion.geometry.map_answers import PointCloud
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.origin import Origin


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    random = np.random.default_rng(1)
    normals = random.standard_normal((500, 3))
    return Mesh(
        (random.random((500, 3)) * (20, 30, 3) + (400, -90, 1)).astype(np.float32),
        np.arange(498, dtype=np.int32).reshape(-1, 3),
        (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32),
        random.integers(0, 256, (500, 3), dtype=np.uint8),
        provenance=Provenance(source="yard.tsf", keyframes=9),
    )


def columns(read: NDArray[np.generic], names: str) -> NDArray[np.generic]:
    return np.stack([read[name] for name in names.split()], axis=1)


def test_ply(mesh: Mesh, tmp_path: Path) -> None:
    read = meshio.read(mesh.save_points(tmp_path / "m.ply"))
    assert (read.points == mesh.vertices).all()
    assert (columns(read.point_data, "nx ny nz") == mesh.normals).all()
    assert (columns(read.point_data, "red green blue").astype(np.uint8) == mesh.colors).all()
    assert b"comment source yard.tsf\n" in (tmp_path / "m.ply").read_bytes()


def test_pcd(mesh: Mesh, tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    cloud = pypcd4.PointCloud.from_path(mesh.save_points(tmp_path / "m.pcd"))
    read = cloud.pc_data
    assert (columns(read, "x y z") == mesh.vertices).all()
    assert (columns(read, "normal_x normal_y normal_z") == mesh.normals).all()
    assert (pypcd4.PointCloud.decode_rgb(np.ascontiguousarray(read["rgb"])) == mesh.colors).all()
    assert b"# keyframes 9\n" in (tmp_path / "m.pcd").read_bytes()


def test_pcd_holds_the_bytes_of_the_format(mesh: Mesh, tmp_path: Path) -> None:
    """Read by its header, without a library."""
    head, _, body = mesh.save_points(tmp_path / "m.pcd").read_bytes().partition(b"DATA binary\n")
    lines = dict(line.split(" ", 1) for line in head.decode().splitlines())
    assert lines["FIELDS"] == "x y z normal_x normal_y normal_z rgb"
    assert (lines["SIZE"], lines["COUNT"]) == (" ".join("4444444"), " ".join("1111111"))
    assert (lines["TYPE"], lines["POINTS"]) == (" ".join("FFFFFFF"), "500")
    rows = np.frombuffer(body, "<f4").reshape(500, 7)
    assert (rows[:, :3] == mesh.vertices).all()
    assert (rows[:, 3:6] == mesh.normals).all()
    bits = np.ascontiguousarray(rows[:, 6]).view("<u4")
    assert (np.stack((bits >> 16, bits >> 8, bits), axis=1) & 255 == mesh.colors).all()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_and_laz(mesh: Mesh, tmp_path: Path, suffix: str) -> None:
    read = laspy.read(mesh.save_points(tmp_path / f"m{suffix}"))
    assert np.stack((read.x, read.y, read.z), axis=1) == pytest.approx(mesh.vertices, abs=0.6e-5)
    assert (columns(read, "normal_x normal_y normal_z") == mesh.normals).all()
    assert (columns(read, "red green blue") == mesh.colors.astype(int) * 257).all()
    (about,) = [one for one in read.header.vlrs if one.user_id == "tsfusion"]
    assert b"source yard.tsf\n" in about.record_data
    assert read.header.generating_software.startswith("tsfusion ")


def test_las_has_the_coordinates_that_the_poses_came_with(mesh: Mesh, tmp_path: Path) -> None:
    there = Origin((447_800, 5_411_400, 300))
    read = laspy.read(point_files.save(tmp_path / "m.las", mesh.vertices, origin=there))
    places = np.stack((read.x, read.y, read.z), axis=1)
    assert places - there.position == pytest.approx(mesh.vertices, abs=0.6e-5)


def test_las_holds_the_bytes_of_the_standard(mesh: Mesh, tmp_path: Path) -> None:
    """Read by the offsets of ASPRS's LAS 1.4 R15, without a library."""
    content = mesh.save_points(tmp_path / "m.las").read_bytes()
    assert (content[:4], content[24], content[25]) == (b"LASF", 1, 4)
    assert struct.unpack_from("<H", content, 6)[0] & 16, "the WKT bit, which these formats must have"
    start, _, kind, size = struct.unpack_from("<IIBH", content, 96)
    assert kind == 7
    (count,) = struct.unpack_from("<Q", content, 247)
    numbers = struct.unpack_from("<12d", content, 131)
    rows = np.frombuffer(content, np.uint8, count * size, start).reshape(count, size)
    places = np.ascontiguousarray(rows[:, :12]).view("<i4") * numbers[:3] + numbers[3:6]
    assert places == pytest.approx(mesh.vertices, abs=0.6e-5)
    box = [mesh.vertices.max(axis=0), mesh.vertices.min(axis=0)]
    assert pytest.approx(np.array(box), abs=1e-4) == np.reshape(numbers[6:], (3, 2)).T
    assert (np.ascontiguousarray(rows[:, 30:36]).view("<u2") == mesh.colors.astype(int) * 257).all()


def test_the_cloud_of_a_map_is_saved_with_what_it_has(mesh: Mesh, tmp_path: Path) -> None:
    weights = np.ones(len(mesh.vertices), np.float32)
    cloud = PointCloud(mesh.vertices, mesh.normals, weights, mesh.colors)
    read = meshio.read(cloud.save(tmp_path / "m.ply"))
    assert (read.points == mesh.vertices).all()
    assert (columns(read.point_data, "nx ny nz") == mesh.normals).all()
    assert b"comment unit metre\n" in (tmp_path / "m.ply").read_bytes()


def test_points_alone_are_enough(mesh: Mesh, tmp_path: Path) -> None:
    for suffix in (".ply", ".las"):
        file = point_files.save(tmp_path / f"m{suffix}", mesh.vertices)
        read = meshio.read(file).points if suffix == ".ply" else laspy.read(file).xyz
        assert read == pytest.approx(mesh.vertices, abs=1e-5)


def test_points_that_cannot_be_saved_say_why(
    mesh: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match=r"points are saved as .ply, .pcd, .las, .laz, got 'm.xyz'"):
        mesh.save_points(tmp_path / "m.xyz")
    with pytest.raises(OutputError, match="no points"):
        point_files.save(tmp_path / "m.pcd", mesh.vertices[:0])
    with pytest.raises(OutputError, match="cannot write"):
        mesh.save_points(tmp_path / "none" / "m.pcd")
    far = np.float32([[0, 0, 0], [50_000, 0, 0]])
    with pytest.raises(OutputError, match="21 km"):
        point_files.save(tmp_path / "m.las", far)
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingDependency, match=r"pip install 'laspy\[lazrs\]'"):
        mesh.save_points(tmp_path / "m.las")
    assert list(tmp_path.iterdir()) == []
