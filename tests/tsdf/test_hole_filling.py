# SPDX-License-Identifier: MIT
"""Holes up to a width are closed where the field leads, marked as guessed; nothing else is touched."""

from itertools import product

import numpy as np
import pytest
import trimesh
from block_stores import store_of
from formula_scenes import tilted_plane, volume_of
from numpy.typing import NDArray

from tsfusion import Mesh, Volume
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.mesh_simplification import border_edges
from tsfusion.tsdf.store.block_store import pack_keys
from tsfusion.tsdf.surface import hole_filling
from tsfusion.tsdf.surface.field_regularizer import values_of
from tsfusion.tsdf.surface.hole_filling import extract_filled
from tsfusion.tsdf.surface.mesh_extraction import extract

SIDE = 64  # voxels
QUANTA = 60
BAND = 4.0  # voxels


def meshes(distance: NDArray[np.float64], seen: NDArray[np.bool_], voxels: int) -> tuple[Mesh, Mesh]:
    """Without and with holes filled, of a (SIDE, SIDE, SIDE) field in voxels; lengths in voxels, too."""
    blocks = np.array(list(product(range(SIDE // 8), repeat=3)))
    weight = np.where(seen & (np.abs(distance) < BAND), 160, 0)
    sums = (np.rint(distance.clip(-16, 16) * QUANTA).astype(np.int64) * weight << 27) + weight
    rows = sums.reshape(8, 8, 8, 8, 8, 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
    used = rows.any(axis=1)
    store = store_of(pack_keys(blocks[used]), np.ascontiguousarray(rows[used]))
    plain = extract(np.sort(store.keys), store, 1.0)
    return plain, extract_filled(store, 1.0, values_of, voxels)


def points() -> NDArray[np.float64]:
    """Centres of the voxels from the middle, (SIDE, SIDE, SIDE, 3)."""
    along = np.arange(SIDE) + 0.5 - SIDE / 2
    return np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1)


def from_middle(mesh: Mesh) -> NDArray[np.float64]:
    return mesh.vertices.astype(np.float64) - SIDE / 2


def disc(p: NDArray[np.float64], width: float) -> NDArray[np.bool_]:
    """Above the middle, within half a width of the z axis."""
    return (np.hypot(p[..., 0], p[..., 1]) < width / 2) & (p[..., 2] > 0)


def check_marked(plain: Mesh, filled: Mesh) -> None:
    """Triangles that are not guessed are those of the plain mesh."""
    assert filled.guessed is not None
    seen = filled.of_faces(~filled.guessed)
    assert (seen.faces == plain.faces).all()
    assert (seen.vertices == plain.vertices).all()
    assert (seen.normals == plain.normals).all()


@pytest.mark.parametrize(("width", "most"), [(5, 0.1), (9, 0.2), (15, 0.5)])
def test_a_hole_in_a_sphere_is_closed_as_the_sphere_would(width: int, most: float) -> None:
    p = points()
    plain, filled = meshes(np.linalg.norm(p, axis=-1) - 20.0, ~disc(p, width), width)
    assert len(border_edges(plain.faces)) > 0
    check_marked(plain, filled)
    assert len(border_edges(filled.faces)) == 0
    guess = filled.of_faces(filled.guessed)
    off = np.abs(np.linalg.norm(from_middle(guess), axis=1) - 20.0)
    assert off.max() < most  # voxels
    outward = from_middle(guess) / np.linalg.norm(from_middle(guess), axis=1, keepdims=True)
    assert (guess.normals * outward).sum(axis=1).min() > 0.9


def test_a_hole_in_a_tilted_plane_is_closed_by_the_plane() -> None:
    p = points()
    normal = np.array((0.3, -0.2, 0.93)) / np.linalg.norm((0.3, -0.2, 0.93))
    inside = (np.abs(p) < 24).all(axis=-1)
    plain, filled = meshes(p @ normal, inside & ~(np.hypot(p[..., 0], p[..., 1]) < 5), 10)
    check_marked(plain, filled)
    guess = filled.of_faces(filled.guessed)
    assert np.abs(from_middle(guess) @ normal).max() < 0.02
    assert (guess.normals @ normal).min() > 0.99


@pytest.mark.parametrize("width", [12, 20, 34])
def test_a_hole_that_is_too_wide_stays_as_it_is(width: int) -> None:
    p = points()
    plain, filled = meshes(np.linalg.norm(p, axis=-1) - 20.0, ~disc(p, width), 8)
    assert filled.guessed is None
    assert (filled.faces == plain.faces).all()
    assert (filled.vertices == plain.vertices).all()
    assert (filled.normals == plain.normals).all()


def test_the_border_of_a_scan_grows_no_flaps() -> None:
    """A ragged rim, a corner of two walls that ends, and a fringe of crumbs."""
    p, random = points(), np.random.default_rng(3)
    distance = np.minimum(p[..., 0] + 9.0, p[..., 2] + 9.0)
    rim = 20 + 3 * random.random((SIDE, SIDE))[None, :, :]
    seen = (p[..., 0] < rim) & (np.abs(p[..., 1]) < 22) & (p[..., 2] < 18)
    seen &= (p[..., 2] < 10) | (random.random(seen.shape) < 0.98)
    plain, filled = meshes(distance, seen, 10)
    ends = [from_middle(mesh) for mesh in (plain, filled)]
    assert (np.abs(ends[1]).max(axis=0) == np.abs(ends[0]).max(axis=0)).all()
    guess = filled.of_faces(filled.guessed)
    assert len(guess.faces) > 30  # of the holes in the fringe
    # each free edge of the filled mesh is one of the plain mesh
    free = {tuple(sorted(map(tuple, filled.vertices[edge].tolist()))) for edge in border_edges(filled.faces)}
    assert free <= {
        tuple(sorted(map(tuple, plain.vertices[edge].tolist()))) for edge in border_edges(plain.faces)
    }
    corner = np.minimum(from_middle(guess)[:, 0] + 9.0, from_middle(guess)[:, 2] + 9.0)
    assert np.quantile(np.abs(corner), 0.99) < 0.5


def test_a_hole_as_wide_as_blocks_that_nobody_saw_is_closed() -> None:
    """Blocks in the middle are not in the map at all."""
    p = points()
    plain, filled = meshes(np.linalg.norm(p, axis=-1) - 26.0, ~disc(p, 24), 24)
    check_marked(plain, filled)
    assert len(border_edges(filled.faces)) == 0
    assert np.abs(np.linalg.norm(from_middle(filled), axis=1) - 26.0).max() < 1.0


def test_batches_change_nothing_that_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    p = points()
    distance, seen = np.linalg.norm(p, axis=-1) - 20.0, ~disc(p, 9)
    _, whole = meshes(distance, seen, 9)
    monkeypatch.setattr(hole_filling, "BATCH", 3)
    _, parts = meshes(distance, seen, 9)
    assert (parts.faces == whole.faces).all()
    assert parts.vertices == pytest.approx(whole.vertices, abs=1e-3)


def test_guessed_surface_has_the_colours_around_it() -> None:
    volume = holed_volume()
    filled = volume.extract_mesh(fill_holes=12)
    assert filled.guessed is not None
    guess = filled.of_faces(filled.guessed)
    assert guess.colors == pytest.approx(np.broadcast_to((200, 120, 40), guess.colors.shape), abs=2)
    marked = filled.with_guesses_marked()
    assert (marked.colors[marked.faces[marked.guessed]] == (230, 40, 190)).all()
    assert (marked.colors[marked.faces[~marked.guessed]] == (200, 120, 40)).all()
    assert (
        marked.vertices[marked.faces[~marked.guessed]] == filled.vertices[filled.faces[~filled.guessed]]
    ).all()


def holed_volume() -> Volume:
    """A coloured plane with a hole of about 10 voxels."""
    from dataclasses import replace

    _, views = tilted_plane()
    color = np.full((*views[0].depth.shape, 3), (40, 120, 200), np.uint8)  # BGR
    holed = []
    for view in views:
        depth = view.depth.copy()
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        T, K = view.T_world_camera, view.intrinsics
        rays = np.dstack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(depth.shape)])
        world = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
        depth[np.hypot(world[..., 0] - 0.1, world[..., 1]) < 0.1] = 0
        holed.append(replace(view, depth=depth, color=color))
    return volume_of(holed)


def test_what_cannot_be_filled_is_refused() -> None:
    volume = holed_volume()
    for voxels in (0, -3, 65):
        with pytest.raises(InvalidConfig, match="1 to 64 voxels"):
            volume.extract_mesh(fill_holes=voxels)
    with pytest.raises(InvalidConfig, match="whole map"):
        volume.extract_mesh(blocks=np.zeros((1, 3), np.int32), fill_holes=5)
    assert Volume(0.02).extract_mesh(fill_holes=5).faces.shape == (0, 3)


def test_a_crumb_grows_no_bubble() -> None:
    """A small piece of a plane, and a large one with a hole that is closed."""
    p = points()
    crumb = np.hypot(p[..., 0] - 24, p[..., 1] - 24) < 3
    plate = (np.abs(p[..., :2]) < 16).all(axis=-1) & (np.hypot(p[..., 0], p[..., 1]) > 4)
    plain, filled = meshes(p[..., 2] - 0.2, (crumb | plate) & (np.abs(p[..., 2]) < 1.6), 14)
    check_marked(plain, filled)
    ends = from_middle(filled.of_faces(filled.guessed))
    assert np.abs(ends[:, :2]).max() < 6
    assert np.abs(ends[:, 2] - 0.2).max() < 0.05


def test_a_patch_is_not_larger_than_what_it_hangs_on() -> None:
    """A ball, closed from a larger and from a smaller part of it."""
    ball = trimesh.creation.icosphere(2)
    for share, stays in ((0.3, True), (0.7, False)):
        guessed = ball.triangles_center[:, 2] > 1 - 2 * share
        vertices = ball.vertices.astype(np.float32)
        mesh = Mesh(vertices, ball.faces.astype(np.int32), vertices, guessed=guessed)
        found = hole_filling.closing(mesh)
        assert (found.guessed is not None) == stays
        assert len(found.faces) == (len(guessed) if stays else (~guessed).sum())
