# SPDX-License-Identifier: MIT
"""Meshes are saved whole or not at all, the right way up, without islands where that is asked for."""

import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import trimesh
from command_processes import python
from formula_scenes import sphere_views, volume_of

from tsfusion import Mesh, MissingDependency
from tsfusion.core.errors import OutputError
from tsfusion.geometry import mesh_islands, up_direction


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_a_saved_mesh_reads_back(tmp_path: Path, suffix: str) -> None:
    mesh = replace(volume_of(sphere_views(0.4, 6)).extract_mesh(), held=None)
    loaded = trimesh.load(mesh.save(tmp_path / f"m{suffix}"), force="mesh", process=False)
    assert loaded.faces.shape == mesh.faces.shape
    assert np.allclose(np.sort(loaded.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=1e-6)
    assert list(tmp_path.iterdir()) == [tmp_path / f"m{suffix}"]


def test_a_mesh_that_cannot_be_saved_says_why_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no triangles"):
        volume_of([]).extract_mesh().save(tmp_path / "m.ply")
    mesh = volume_of(sphere_views(0.4, 2)[:1]).extract_mesh()
    with pytest.raises(OutputError, match=r"\.ply, \.glb, \.obj, \.stl"):
        mesh.save(tmp_path / "m.fbx")
    with pytest.raises(OutputError, match="cannot write"):
        mesh.save(tmp_path / "missing" / "m.ply")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    closed = volume_of(sphere_views(0.4, 12), min_behind=2)  # few rays at a slant: no hole
    return replace(closed.extract_mesh(), held=None)


def with_up(mesh: Mesh, text: str) -> Mesh:
    return replace(mesh, known_up=up_direction.parse(text))


def loaded(path: Path) -> trimesh.Trimesh:
    return trimesh.load(path, force="mesh", process=False)


@pytest.mark.parametrize("axis", ["z", "-y", "y", "0.1,-0.9,0.2"])
def test_glb_has_y_up_and_the_others_keep_the_frame(sphere: Mesh, tmp_path: Path, axis: str) -> None:
    mesh = with_up(sphere, axis)
    up = np.array(mesh.up.direction)
    turned = loaded(mesh.save(tmp_path / "m.glb"))
    assert turned.vertices[:, 1] == pytest.approx(mesh.vertices @ up, abs=1e-5)
    (shape,) = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    assert shape.vertices == pytest.approx(mesh.vertices)  # the node turns them
    assert shape.vertex_normals == pytest.approx(mesh.normals, abs=1e-5)
    assert turned.volume == pytest.approx(mesh.to_trimesh().volume, rel=1e-4)  # not mirrored
    for name in ("m.ply", "m.obj"):
        assert loaded(mesh.save(tmp_path / name)).vertices == pytest.approx(mesh.vertices, abs=1e-6)
        head = (tmp_path / name).read_bytes()[:400]
        assert f"up {mesh.up}\n".encode() in head
        assert b"unit metre" in head
    sphere.save(tmp_path / "unknown.ply")
    assert b"\ncomment up unknown\n" in (tmp_path / "unknown.ply").read_bytes()[:400]
    assert loaded(sphere.save(tmp_path / "m.glb")).vertices == pytest.approx(mesh.vertices)


def test_glb_colours_are_linear_light(sphere: Mesh, tmp_path: Path) -> None:
    assert sphere.colors is not None
    random = np.random.default_rng(0)
    mesh = replace(sphere, colors=random.integers(0, 256, sphere.colors.shape, dtype=np.uint8))
    gltf = pygltflib.GLTF2().load(str(mesh.save(tmp_path / "m.glb")))
    (part,) = gltf.meshes[0].primitives
    accessor = gltf.accessors[part.attributes.COLOR_0]
    assert (accessor.componentType, accessor.normalized) == (pygltflib.UNSIGNED_SHORT, True)
    start = gltf.bufferViews[accessor.bufferView].byteOffset
    saved = np.frombuffer(gltf.binary_blob(), "<u2", 4 * accessor.count, start).reshape(-1, 4)
    share = mesh.colors / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    assert saved[:, :3] == pytest.approx(65535 * linear, abs=0.51)
    assert (saved[:, 3] == 65535).all()
    assert len(np.unique(saved[:, :3])) == 256  # the darkest levels, too
    assert gltf.materials[part.material].pbrMetallicRoughness.metallicFactor == 0.0


def test_a_ply_is_the_mesh_of_trimesh(sphere: Mesh, tmp_path: Path) -> None:
    """`to_trimesh` and a saved file read back are one thing, to the last bit (trimesh reads no normals)."""
    made, read = sphere.to_trimesh(), loaded(sphere.save(tmp_path / "m.ply"))
    assert (made.vertices == read.vertices).all()
    assert (made.faces == read.faces).all()
    assert (made.vertex_normals.astype(np.float32) == sphere.normals).all()
    assert (made.visual.vertex_colors == read.visual.vertex_colors).all()


def test_open3d_gets_the_mesh(sphere: Mesh, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    made, read = (
        sphere.to_open3d().to_legacy(),
        open3d.io.read_triangle_mesh(str(sphere.save(tmp_path / "m.ply"))),
    )
    for name in ("vertices", "triangles", "vertex_normals", "vertex_colors"):
        assert np.asarray(getattr(made, name)) == pytest.approx(np.asarray(getattr(read, name)), abs=1e-6)


def test_without_open3d_one_line_says_so(sphere: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependency, match=r"^Open3D is not installed \(pip install open3d\)$"):
        sphere.to_open3d()


def beside(mesh: Mesh, other: Mesh) -> Mesh:
    """Two meshes as one."""
    return Mesh(
        np.concatenate((mesh.vertices, other.vertices + np.float32(5))),
        np.concatenate((mesh.faces, other.faces + len(mesh.vertices))),
        np.concatenate((mesh.normals, other.normals)),
        np.concatenate((mesh.colors, other.colors)),
    )


def crumb(vertices: int) -> Mesh:
    """A strip of triangles."""
    start = np.arange(vertices - 2, dtype=np.int32)
    points = np.stack((np.arange(vertices) // 2, np.arange(vertices) % 2, np.zeros(vertices)), axis=1)
    normals = np.tile(np.float32((0, 0, 1)), (vertices, 1))
    faces = np.stack((start, start + 1, start + 2), axis=1)
    return Mesh(points.astype(np.float32), faces, normals, np.zeros((vertices, 3), np.uint8))


def test_islands_go_and_are_counted(sphere: Mesh) -> None:
    scattered = beside(beside(beside(sphere, crumb(49)), crumb(50)), crumb(3))
    tidy = scattered.without_islands()
    expected = beside(sphere, crumb(50))
    assert len(tidy.vertices) == len(expected.vertices)
    assert (tidy.faces == expected.faces).all()
    assert (tidy.normals == expected.normals).all()
    assert (tidy.colors == expected.colors).all()
    assert (scattered.figures["islands"], scattered.figures["island_triangles"]) == (2, 48)
    assert tidy.figures["islands"] == 0
    assert tidy.without_islands() is tidy


def test_a_scene_of_islands_stays() -> None:
    crumbs = beside(crumb(20), crumb(30))
    assert crumbs.without_islands() is crumbs
    assert crumbs.figures["islands"] == 0


def test_pieces_are_those_of_a_graph_library() -> None:
    csgraph, sparse = pytest.importorskip("scipy.sparse.csgraph"), pytest.importorskip("scipy.sparse")
    random = np.random.default_rng(0)
    for vertices, triangles in ((1000, 150), (1000, 400), (300, 2), (5000, 5000), (4, 0)):
        faces = random.integers(0, vertices, (triangles, 3), dtype=np.int32)
        chain = np.arange(vertices // 2, dtype=np.int32)  # a long one, numbered at random
        faces = np.concatenate((faces, np.stack((chain[:-1], chain[1:], chain[1:]), axis=1)))
        faces = random.permutation(vertices).astype(np.int32)[faces]
        edges = np.concatenate((faces[:, :2], faces[:, 1:])).T
        graph = sparse.coo_matrix((np.ones(edges.shape[1]), edges), (vertices, vertices))
        count, other = csgraph.connected_components(graph, directed=False)
        found = mesh_islands.pieces(faces, vertices)
        assert len(np.unique(found)) == len(np.unique(found * count + other)) == count


def test_a_mesh_in_one_line(sphere: Mesh) -> None:
    mesh = with_up(beside(sphere, crumb(3)), "z")
    vertices, triangles = (f"{len(each):,}".replace(",", "\u202f") for each in (mesh.vertices, mesh.faces))
    extent = " × ".join(f"{length:.2f}" for length in np.ptp(mesh.vertices, axis=0))
    assert mesh.summary == (
        f"{vertices} vertices, {triangles} triangles, {extent} m, 1 island (0.0 %), "
        "up +z (given: 0.0000 0.0000 1.0000)"
    )
    empty = volume_of([]).extract_mesh().summary
    assert empty == "0 vertices, 0 triangles, 0.00 × 0.00 × 0.00 m, 0 islands (0.0 %), up unknown"


_PRESSED_WHILE_IT_LOADS = """
import os, signal, sys
import numpy as np
from tsfusion import Mesh

class Pressing:
    def find_spec(self, name, *_):
        if name == "scipy.spatial":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), int(sys.argv[1]))

sys.meta_path.insert(0, Pressing())
signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
floats = np.eye(3, dtype=np.float32)
try:
    Mesh(floats, np.array([[0, 1, 2]], dtype=np.int32), floats, None).encode(".ply")
except KeyboardInterrupt:
    sys.exit("interrupted")
"""


@pytest.mark.parametrize(("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
def test_who_wants_it_to_end_is_heard_while_trimesh_loads(number: signal.Signals, word: str) -> None:
    done = python(_PRESSED_WHILE_IT_LOADS, int(number))
    assert (done.returncode, done.stderr.strip()) == (1, word)
