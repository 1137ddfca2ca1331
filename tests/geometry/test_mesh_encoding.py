# SPDX-License-Identifier: MIT
"""Files of meshes, read back by libraries that did not write them, and what the files say."""

import struct
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pygltflib
import pytest
import stl
from formula_scenes import sphere_views, volume_of
from gltf_validation import problems
from numpy.typing import NDArray

from tsfusion import Mesh
from tsfusion.geometry import up_direction
from tsfusion.geometry.mesh_arrays import Provenance

KNOWN = Provenance(source="room.tsf", keyframes=6, map_hash="ab" * 16, world="w1", voxel_size=0.02)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """A sphere, the upper part of which is guessed."""
    found = volume_of(sphere_views(0.2, 6)).extract_mesh()
    guessed = (found.vertices[found.faces][:, :, 2] > 0.1).any(axis=1)
    assert 0 < guessed.sum() < len(guessed)
    random = np.random.default_rng(0)
    colors = random.integers(0, 256, found.vertices.shape, dtype=np.uint8)
    return replace(found, known_up=up_direction.parse("z"), provenance=KNOWN, guessed=guessed, colors=colors)


def test_ply(mesh: Mesh, tmp_path: Path) -> None:
    read = meshio.read(replace(mesh, guessed=None).save(tmp_path / "m.ply"))
    assert (read.points == mesh.vertices).all()
    assert (read.cells_dict["triangle"] == mesh.faces).all()
    for axis, name in enumerate(("nx", "ny", "nz")):
        assert (read.point_data[name] == mesh.normals[:, axis]).all()
    for channel, name in enumerate(("red", "green", "blue")):  # which meshio takes for signed
        assert (read.point_data[name].astype(np.uint8) == mesh.colors[:, channel]).all()


def test_ply_has_what_is_guessed_at_its_end_and_says_so(mesh: Mesh, tmp_path: Path) -> None:
    path = mesh.save(tmp_path / "m.ply")
    faces = meshio.read(path).cells_dict["triangle"]  # which knows no properties of faces but lists
    seen = len(mesh.faces) - mesh.guessed.sum()
    assert (faces[:seen] == mesh.faces[~mesh.guessed]).all()
    assert (faces[seen:] == mesh.faces[mesh.guessed]).all()
    head = path.read_bytes().partition(b"end_header\n")[0].decode().splitlines()
    for line in (
        "unit metre", f"up {mesh.up}", "source room.tsf", "keyframes 6", f"map_hash {'ab' * 16}", "world w1",
        "voxel_size_m 0.02",
        f"guessed {mesh.guessed.sum()} of {len(mesh.faces)} triangles, the last of a PLY, "
        "where nothing was seen",
    ):  # fmt: skip
        assert f"comment {line}" in head
    assert any(line.startswith("comment generator tsfusion ") for line in head)


def test_obj(mesh: Mesh, tmp_path: Path) -> None:
    text = mesh.save(tmp_path / "m.obj").read_text().splitlines()
    assert "# unit metre" in text
    assert f"# map_hash {'ab' * 16}" in text
    assert [line for line in text if line.startswith("o ")] == ["o seen", "o guessed"]
    corners = np.array([[float(word) for word in line.split()[1:]] for line in text if line[:2] == "v "])
    faces = [line.split()[1:] for line in text if line[:2] == "f "]
    numbers = np.array([[int(corner.partition("/")[0]) for corner in face] for face in faces]) - 1
    order = np.concatenate([np.flatnonzero(~mesh.guessed), np.flatnonzero(mesh.guessed)])
    assert corners[numbers][:, :, :3] == pytest.approx(mesh.vertices[mesh.faces[order]], abs=1e-6)
    shades = corners[numbers][:, :, 3:6] * 255
    assert shades == pytest.approx(mesh.colors[mesh.faces[order]].astype(float), abs=0.01)


def test_stl(mesh: Mesh, tmp_path: Path) -> None:
    read = stl.mesh.Mesh.from_file(str(mesh.save(tmp_path / "m.stl")), calculate_normals=False)
    assert (read.vectors == mesh.vertices[mesh.faces]).all()
    assert (read.attr[:, 0] == mesh.guessed).all()
    across = np.cross(read.v1 - read.v0, read.v2 - read.v0)
    assert ((across * read.normals).sum(axis=1) >= 0).all()
    assert (tmp_path / "m.stl").read_bytes()[:80].startswith(b"tsfusion ")
    assert b"metre, up +z" in (tmp_path / "m.stl").read_bytes()[:80]


_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def values(gltf: pygltflib.GLTF2, number: int) -> NDArray[np.generic]:
    """An accessor's values, checked against what the accessor says."""
    accessor = gltf.accessors[number]
    view = gltf.bufferViews[accessor.bufferView]
    dtype, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[accessor.type]
    start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
    assert start % 4 == 0
    assert accessor.count * width * dtype.itemsize <= view.byteLength
    found = np.frombuffer(gltf.binary_blob(), dtype, accessor.count * width, start).reshape(-1, width)
    if accessor.min is not None:
        assert np.array_equal(found.min(axis=0), np.array(accessor.min, dtype))
        assert np.array_equal(found.max(axis=0), np.array(accessor.max, dtype))
    return found


def test_glb(mesh: Mesh, tmp_path: Path) -> None:
    gltf = pygltflib.GLTF2().load(str(mesh.save(tmp_path / "m.glb")))
    assert gltf.asset.generator.startswith("tsfusion ")
    assert gltf.asset.extras["map_hash"] == KNOWN.map_hash
    assert gltf.asset.extras["unit"] == "metre"
    assert gltf.buffers[0].byteLength <= len(gltf.binary_blob())
    turn = mesh.up.to_y()
    assert "the nodes' matrices turn up to +y" in gltf.asset.extras["frame"]
    names = {
        gltf.nodes[k].name: gltf.nodes[k].mesh
        for k in range(len(gltf.nodes))
        if gltf.nodes[k].mesh is not None
    }
    for name, which in (("seen", ~mesh.guessed), ("guessed", mesh.guessed)):
        (part,) = gltf.meshes[names[name]].primitives
        assert gltf.accessors[part.attributes.POSITION].min is not None
        corners = values(gltf, part.attributes.POSITION)[values(gltf, part.indices).reshape(-1, 3)]
        assert (corners == mesh.vertices[mesh.faces[which]]).all()
        (node,) = (node for node in gltf.nodes if node.name == name)
        assert np.reshape(node.matrix, (4, 4)).T[:3, :3] == pytest.approx(turn, abs=1e-6)
        normals = values(gltf, part.attributes.NORMAL)
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=1e-5)
        assert values(gltf, part.attributes.COLOR_0).shape == (len(normals), 4)
        assert gltf.accessors[part.attributes.COLOR_0].normalized
        assert gltf.materials[part.material].pbrMetallicRoughness.metallicFactor == 0, "else it is dark"


def test_khronos_calls_the_glb_valid(mesh: Mesh, tmp_path: Path) -> None:
    for number, guessed in enumerate((None, mesh.guessed)):
        assert problems(replace(mesh, guessed=guessed).save(tmp_path / f"{number}.glb")) == []


def test_an_stl_is_of_the_size_that_it_says(mesh: Mesh) -> None:
    content = mesh.encode(".stl")
    assert struct.unpack_from("<I", content, 80) == (len(mesh.faces),)
    assert len(content) == 84 + 50 * len(mesh.faces)
