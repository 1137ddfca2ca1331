# SPDX-License-Identifier: MIT
"""Marching cubes: closed, manifold, without cracks or duplicates, and where the surface is."""

from collections import Counter
from collections.abc import Callable
from math import inf, nan
from pathlib import Path

import kernel_twins
import numpy as np
import pytest
import trimesh
from block_stores import store_of
from failures import raising
from formula_scenes import sphere_views, tilted_plane, volume_of
from kernel_twins import Voxel
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lab.evaluation import stanford_bunny
from tsfusion import Mesh, Volume
from tsfusion.core.errors import InvalidConfig
from tsfusion.kernels.surface import surface_cells
from tsfusion.tsdf.store.block_store import BlockStore, cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.surface import mesh_extraction
from tsfusion.tsdf.surface.mesh_extraction import MeshBuffers, extract


def edge_uses(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """The edges (n, 2), and how many triangles use each."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


def check_sound(mesh: Mesh) -> None:
    assert edge_uses(mesh.faces)[1].max() <= 2
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)  # none unused
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)  # none twice
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


def random_map(
    seed: int, known: float
) -> tuple[BlockStore, NDArray[np.int64], dict[Voxel, float], dict[Voxel, tuple[float, ...]]]:
    """A 3×2×2 patch of blocks around the origin: noise in all 256 cases, a share of voxels unseen, a third
    coloured. Returns the map, the keys, and values and colours by voxel."""
    random = np.random.default_rng(seed)
    coordinates = np.array([(x, y, z) for x in (-2, -1, 0) for y in (-1, 0) for z in (-1, 0)], np.int32)
    keys = pack_keys(coordinates)
    distance = random.integers(-500, 500, (12, 512))
    weight = 160 * (random.random((12, 512)) < known)
    sums = (distance * weight << 27) + weight
    votes = random.integers(1, 9, (12, 512)) * (random.random((12, 512)) < 0.33)
    channels = random.integers(0, 256, (3, 12, 512)) * votes
    rgn = (channels[0] << 40) + (channels[1] << 16) + votes
    values, colors = {}, {}
    for slot, offset in np.ndindex(12, 512):
        voxel = coordinates[slot] * 8 + (offset >> 6, offset >> 3 & 7, offset & 7)
        key = (int(voxel[0]), int(voxel[1]), int(voxel[2]))
        if weight[slot, offset]:
            values[key] = float(distance[slot, offset])
        if votes[slot, offset]:
            colors[key] = tuple(channels[:, slot, offset] / votes[slot, offset])
    return store_of(keys, sums, color_rgn=rgn, color_b=channels[2]), keys, values, colors


def triangles_of(mesh: Mesh) -> Counter:
    """Triangles by their exact corners."""
    return Counter(frozenset(map(tuple, t)) for t in mesh.vertices[mesh.faces].tolist())


def summary(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centre and area vector of (n, 3, 3) triangles."""
    a, b, c = triangles.transpose(1, 0, 2)
    return np.hstack([(a + b + c) / 3, np.cross(b - a, c - a)])


@pytest.mark.parametrize("known", [1.0, 0.9])
def test_extraction_equals_the_twin_on_noise(known: float) -> None:
    store, keys, values, colors = random_map(3, known)
    mesh = extract(np.sort(keys), store, 1.0)
    expected = np.array(kernel_twins.marching_cubes(values))
    found = mesh.vertices[mesh.faces].astype(np.float64)
    assert found.shape == expected.shape
    # the same triangle may start at another corner: compare centres, areas and normals
    distance, partner = cKDTree(summary(expected)).query(summary(found))
    assert distance.max() < 1e-4
    assert len(np.unique(partner)) == len(found)
    check_sound(mesh)
    for i in range(0, len(mesh.vertices), 29):
        normal, rgb = kernel_twins.vertex(values, colors, mesh.vertices[i].astype(np.float64))
        assert np.allclose(mesh.normals[i], normal, atol=1e-3)
        assert np.abs(mesh.colors[i] - rgb).max() <= 1


def test_noise_gives_a_manifold_with_a_border_only_where_the_map_ends() -> None:
    store, keys, _, _ = random_map(4, 1.0)
    mesh = extract(np.sort(keys), store, 1.0)
    edges, uses = edge_uses(mesh.faces)
    ends = mesh.vertices[edges[uses == 1]]  # (n, 2, 3)
    low, high = np.array([-15.5, -7.5, -7.5]), np.array([7.5, 7.5, 7.5])
    on_border = (np.isclose(ends, low) | np.isclose(ends, high)).all(axis=1).any(axis=1)
    assert on_border.all()


def test_a_sphere_is_closed_with_the_right_radius_and_normals() -> None:
    radius, voxel_size = 0.4, 0.02
    reach = 1.75  # more than the diagonal of a cell: rays at a slant reach all corners
    mesh = volume_of(sphere_views(radius), min_behind=reach).extract_mesh(min_weight=2)
    check_sound(mesh)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.euler_number == 2
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(distance - radius).max() < voxel_size / 2
    assert abs(distance.mean() - radius) < voxel_size / 10
    outward = mesh.vertices / distance[:, None]
    assert (mesh.normals * outward).sum(axis=1).min() > 0.9
    assert (solid.face_normals * outward[mesh.faces[:, 0]]).sum(axis=1).min() > 0
    assert (mesh.colors == (220, 120, 20)).all()


@pytest.mark.parametrize("regularizer", ["off", "ray", "paper"])
def test_a_plane_is_flat_to_a_tenth_of_a_voxel(regularizer: str) -> None:
    normal, views = tilted_plane()
    mesh = volume_of(views, regularizer=regularizer).extract_mesh()
    error = mesh.vertices @ normal - 0.1
    # a border cell's corners were seen from one side only
    assert np.sqrt(np.mean(error**2)) < 0.1 * 0.02
    check_sound(mesh)


def test_tiles_of_dirty_blocks_make_up_the_whole_mesh() -> None:
    views = sphere_views(0.4, 6)
    volume = volume_of(views[:5], surface="raw")
    volume.take_dirty()
    whole = triangles_of(volume.extract_mesh(min_weight=1))
    volume.integrate(views[5])
    changed = cells_of(volume.take_dirty())
    kept = np.array([b for b in blocks_of(volume) if b not in as_set(changed)])
    tiles = Counter[object]()
    for blocks in (changed, kept):
        tiles += triangles_of(volume.extract_mesh(min_weight=1, blocks=blocks))
    assert tiles == triangles_of(volume.extract_mesh(min_weight=1))
    assert tiles != whole


def test_the_mesh_does_not_depend_on_where_blocks_lie_in_memory() -> None:
    views = sphere_views(0.4, 4)
    a, b = (volume_of(each).extract_mesh(min_weight=1) for each in (views, views[::-1]))
    for name in ("vertices", "faces", "normals", "colors"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


@pytest.mark.parametrize("known", [1.0, 0.9])
def test_a_part_equals_the_same_cells_of_the_whole(known: float) -> None:
    store, keys, _, _ = random_map(5, known)
    keys = np.sort(keys)
    whole = extract(keys, store, 1.0)
    looks = {tuple(v): (*n, *c) for v, n, c in zip(
        whole.vertices.tolist(), whole.normals.tolist(), whole.colors.tolist(), strict=True)}  # fmt: skip
    scratch = MeshBuffers()  # what an earlier mesh left in it must not show
    total: Counter = Counter()
    for part in (keys[:0], keys[:1], keys[1:8], keys[8:9], keys[9:]):
        mesh = extract(part, store, 1.0, scratch)
        total += triangles_of(mesh)
        for v, n, c in zip(mesh.vertices.tolist(), mesh.normals.tolist(), mesh.colors.tolist(), strict=True):
            assert looks[tuple(v)] == (*n, *c)
        again = extract(part, store, 1.0)
        assert again.faces.tobytes() == mesh.faces.tobytes()
        assert again.vertices.tobytes() == mesh.vertices.tobytes()
    assert total == triangles_of(whole)


def blocks_of(volume: Volume) -> list[tuple[int, ...]]:
    return [tuple(int(c) for c in b) for b in unpack_keys(volume._store.keys[volume._store.used()])]


def as_set(blocks: NDArray[np.int32]) -> set[tuple[int, ...]]:
    return {tuple(int(c) for c in b) for b in blocks}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *[("min_weight", weight, "min_weight must be from 0 to") for weight in (-1.0, nan, inf, 1e308)],
        ("blocks", np.zeros((2, 2), np.int32), "blocks must be"),
        ("blocks", np.zeros((1, 3)), "blocks must be"),
        ("blocks", np.zeros(3, np.int32), "blocks must be"),
        ("surface", "fild", "surface must be one of"),
    ],
)
def test_what_cannot_be_extracted_is_named(name: str, value: object, message: str) -> None:
    with pytest.raises(InvalidConfig, match=message):
        volume_of([]).extract_mesh(**{name: value})


def test_a_mesh_that_there_is_no_memory_for_leaves_none_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    volume = volume_of(sphere_views(0.4, 1))
    before = volume.stats().scratch_bytes
    monkeypatch.setattr(mesh_extraction, "KEPT_BLOCKS", 8)
    with monkeypatch.context() as patched:
        patched.setattr(surface_cells, "find_cells", raising(MemoryError()))
        with pytest.raises(MemoryError):
            volume.extract_mesh()
    assert volume.stats().scratch_bytes == before
    assert len(volume.extract_mesh().faces) > 0


def test_blocks_that_do_not_exist_give_an_empty_mesh() -> None:
    volume = volume_of(sphere_views(0.4, 2)[:1])
    beyond_reach = [[-1, -1, (1 << 21) + 1], [1 << 30, 0, 0]]
    for blocks in ([[500, 0, 0]], beyond_reach, np.zeros((0, 3))):
        assert len(volume.extract_mesh(blocks=np.array(blocks, np.int32)).faces) == 0


@pytest.mark.parametrize("regularizer", ["off", "ray"])
def test_the_bunny_lies_within_a_millimetre_of_its_reference(
    data: Callable[[str], Path], regularizer: str
) -> None:
    folder = data("stanford_bunny")
    scans = stanford_bunny.scans(folder)
    mesh = volume_of(scans, voxel_size=0.001, sensor="scanner", regularizer=regularizer).extract_mesh()
    surface = trimesh.load(folder / "reconstruction" / "bun_zipper.ply", process=False)
    samples, _ = trimesh.sample.sample_surface(surface, 200_000, seed=0)
    distance = cKDTree(samples).query(mesh.vertices)[0]
    assert np.median(distance) < 0.5e-3
    assert np.percentile(distance, 95) < 1e-3
    assert len(mesh.vertices) > 50_000
