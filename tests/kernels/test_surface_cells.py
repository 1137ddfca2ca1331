# SPDX-License-Identifier: MIT
"""The kernels before marching cubes, against their twins: values, blocks, cells, edges, cases."""

import kernel_twins
import numpy as np
import pytest
from block_stores import store_of
from numpy.typing import NDArray

from tsfusion.kernels.base import block_hash, runtime
from tsfusion.kernels.surface import marching_cubes, surface_cells
from tsfusion.tsdf.store.block_store import cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.surface.field_regularizer import values_of
from tsfusion.tsdf.surface.mesh_extraction import MeshBuffers

PATCH = np.array([(x, y, z) for x in (-2, -1, 0) for y in (-1, 0) for z in (-1, 0, 1) if x + y + z], np.int32)


@pytest.mark.parametrize("wanted", [0, 1, 2, 4, len(PATCH)])
def test_the_blocks_around_equal_the_twin(wanted: int) -> None:
    store = store_of(pack_keys(PATCH), np.zeros((len(PATCH), 512), np.int64))
    chosen = np.random.default_rng(wanted).permutation(PATCH)[:wanted]
    around = (chosen[:, None] + np.array([*np.ndindex(3, 3, 3)]) - 1).reshape(-1, 3)
    expected = {tuple(b) for b in around.tolist()} & {tuple(b) for b in PATCH.tolist()}
    found = MeshBuffers().keys_around(np.sort(pack_keys(chosen)), store)
    assert (np.diff(found) > 0).all()
    assert {tuple(b) for b in unpack_keys(found).tolist()} == expected


@pytest.mark.parametrize("limits", [(0.0, surface_cells.NEVER), (-0.8, 1.3)], ids=["all", "carved"])
@pytest.mark.parametrize("known", [1.0, 0.9])
@pytest.mark.parametrize("wanted", [1, 3, len(PATCH)])
def test_cells_and_edges_equal_the_twin(known: float, wanted: int, limits: tuple[float, float]) -> None:
    random = np.random.default_rng(8)
    order = np.argsort(pack_keys(PATCH))
    keys, coordinates = pack_keys(PATCH)[order], PATCH[order]
    count = len(keys)
    rows = random.normal(size=(count, 512)).astype(np.float32)
    rows[random.random(rows.shape) > known] = np.nan
    rows[3] = np.abs(rows[3])  # a block without a sign change of its own
    chosen = np.sort(random.permutation(count)[:wanted])
    runtime.start(2)
    buffers = MeshBuffers()
    buffers.reserve(count)
    s = {name: getattr(buffers, name).array for name in
         ("around", "seen", "inside", "active", "edges", "starts", "state", "first")}  # fmt: skip
    table = buffers.table(count)
    block_hash.insert_blocks(keys, 0, count, 0, *table)
    surface_cells.find_cells(
        count, keys, wanted, keys[chosen], *table, rows, *limits, marching_cubes.TRIANGLE_COUNT, *s.values()
    )  # fmt: skip

    voxels = (coordinates[:, None] * 8 + np.array([*np.ndindex(8, 8, 8)])).reshape(-1, 3)
    known_values = {
        tuple(v): x for v, x in zip(voxels.tolist(), rows.ravel().tolist(), strict=True) if x == x
    }
    meshed = {tuple(b) for b in coordinates[chosen].tolist()}
    active, edges, triangles = kernel_twins.crossed_cells(known_values, meshed, *limits)
    for r, corner in enumerate(coordinates.tolist()):
        first, end = s["first"][r], s["first"][r + 1]
        here = {v for v in active if [c >> 3 for c in v] == corner}
        assert voxels_in(s["active"][r], corner) == here
        assert end[1] - first[1] == sum(triangles[v] for v in here)
        mine = {(v, axis) for v, axis in edges if [c >> 3 for c in v] == corner}
        assert end[0] - first[0] == len(mine)
        if mine:
            planes = s["edges"][r].reshape(8, 3)
            assert {(v, a) for a in range(3) for v in voxels_in(planes[:, a], corner)} == mine
            per_plane = [bin(int(p)).count("1") for p in s["edges"][r]]
            assert s["starts"][r].tolist() == [0, *np.cumsum(per_plane)[:-1].tolist()]
    assert s["first"][count].tolist() == [len(edges), sum(triangles.values())]


def voxels_in(planes: NDArray[np.uint64], corner: list[int]) -> set[kernel_twins.Voxel]:
    """The voxels of a block whose bits are set in eight planes."""
    bits = [(x, j >> 3, j & 7) for x in range(8) for j in range(64) if int(planes[x]) >> j & 1]
    return {tuple(8 * c + o for c, o in zip(corner, b, strict=True)) for b in bits}  # type: ignore[misc]


def test_no_blocks_have_no_cells() -> None:
    store = store_of(pack_keys(PATCH), np.zeros((len(PATCH), 512), np.int64))
    assert len(MeshBuffers().keys_around(np.zeros(0, np.int64), store)) == 0
    assert cells_of(np.zeros((0, 3), np.int32)).shape == (0, 3)


def test_the_buffers_give_the_memory_of_a_large_mesh_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.tsdf.surface.mesh_extraction.KEPT_BLOCKS", 100)
    buffers = MeshBuffers()
    buffers.reserve(50)
    small = buffers.nbytes
    buffers.release()
    assert buffers.nbytes == small
    buffers.reserve(500)
    assert buffers.nbytes > small
    buffers.release()
    assert buffers.nbytes < small


@pytest.mark.parametrize("smoothed", [False, True])
def test_values_equal_the_twin(smoothed: bool) -> None:
    random = np.random.default_rng(5)
    weight = random.integers(0, 60, (len(PATCH), 512)) << random.integers(0, 20, (len(PATCH), 512))
    sums = (weight * random.integers(-1023, 1024, weight.shape) << 27) + weight
    sums[0, :2] = ((1 << 36) - 1 << 27) + 77, (-(1 << 36) << 27) + 99
    correction = random.normal(0, 99, weight.shape).astype(np.float32) if smoothed else None
    store = store_of(pack_keys(PATCH), sums, correction=correction)
    absent = pack_keys(np.array([[7, 7, 7]], np.int32))
    found = values_of(np.concatenate([pack_keys(PATCH), absent]), store, 2.0)
    distance, weight = (sums >> 27).astype(np.float32), (sums & 0x7FFFFFF).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = distance if correction is None else distance + correction
        expected = np.where(weight >= 32, moved / weight, np.nan)
    assert found.dtype == np.float32
    assert np.array_equal(found[:-1], expected, equal_nan=True)
    assert np.isnan(found[-1]).all()


def test_a_lane_becomes_the_nearest_float() -> None:
    """The two halves a lane is converted in round once, like the whole."""
    lane = np.random.default_rng(6).integers(-(1 << 36), 1 << 36, (1, 512))
    store = store_of(pack_keys(PATCH[:1]), (lane << 27) + 1)
    assert np.array_equal(values_of(pack_keys(PATCH[:1]), store, 0.0), lane.astype(np.float32))


def test_marching_cubes_cases_are_closed_and_complementary() -> None:
    for case in range(256):
        edges = marching_cubes.TRIANGLE_EDGES[case, : 3 * marching_cubes.TRIANGLE_COUNT[case]]
        crossing = {e for e, (a, b) in enumerate(marching_cubes.EDGES) if (case >> a & 1) != (case >> b & 1)}
        assert set(edges.tolist()) == crossing
