# SPDX-License-Identifier: MIT
"""A map with `memory_bytes` is the same map, in so much memory."""

import errno
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from failures import refuse
from formula_scenes import sphere_views, volume_of
from resident_memory import unnamed_files_rss

from tsfusion import Keyframe, Volume
from tsfusion.core import durable_files, process
from tsfusion.core.config import CacheConfig
from tsfusion.core.errors import InvalidConfig, MapFull
from tsfusion.tsdf.store.growing_array import FileArray
from tsfusion.tsdf.store.residency import GROUP, Residency
from tsfusion.tsdf.surface import field_regularizer

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory_bytes needs Linux")

MEMORY = 8 << 20  # bytes
VOXEL = 0.006  # metres: the sphere's map is five times as large as `MEMORY`
BESIDE = 10 << 20  # that a part of the map may take while it is read


@pytest.fixture(scope="module")
def views() -> list[Keyframe]:
    return sphere_views(0.6, 9)


@pytest.fixture(scope="module")
def unbounded(views: list[Keyframe]) -> Volume:
    return volume_of(views, voxel_size=VOXEL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    if durable_files.is_in_memory(tmp_path):
        pytest.skip("the folder for temporary files is a RAM disk")
    return tmp_path


def bounded(folder: Path, views: list[Keyframe], **settings: object) -> Volume:
    """The map of some views in `MEMORY` bytes, looked at after each."""
    volume = Volume(VOXEL, threads=2, memory_bytes=MEMORY, cache=folder, **settings)
    for view in views:
        volume.integrate(view)
        assert unnamed_files_rss(folder) <= MEMORY
    return volume


def test_the_map_is_the_same_and_takes_no_more_memory(
    folder: Path, views: list[Keyframe], unbounded: Volume
) -> None:
    volume = bounded(folder, views)
    assert volume.stats().bytes == unbounded.stats().bytes > 4 * MEMORY
    assert volume.map_hash() == unbounded.map_hash()
    assert volume.color_hash() == unbounded.color_hash()
    assert unnamed_files_rss(folder) <= MEMORY + BESIDE  # hashing has read all of it
    assert list(folder.iterdir()) == []  # the files have no names
    for view in views[::2]:
        volume.retract(view)
    assert volume.map_hash() == volume_of(views[1::2], voxel_size=VOXEL).map_hash()


def test_questions_are_answered_in_no_more_memory(
    folder: Path, views: list[Keyframe], unbounded: Volume
) -> None:
    volume = bounded(folder, views)
    points = unbounded.extract_mesh().vertices[::5]
    points = points + np.random.default_rng(0).normal(0, VOXEL, points.shape)
    for surface in ("raw", "field"):
        found, wanted = (one.sample(points, surface=surface) for one in (volume, unbounded))
        assert np.array_equal(found.distance, wanted.distance, equal_nan=True)
        assert np.array_equal(found.weight, wanted.weight)
        assert np.isfinite(found.distance).sum() > 100
        assert unnamed_files_rss(folder) <= MEMORY + BESIDE
    blocks, distance = volume.blocks(), unbounded.blocks().distance()
    assert np.array_equal(blocks.distance(), distance, equal_nan=True)
    assert np.array_equal(blocks.sums, unbounded.blocks().sums)
    camera = views[0].intrinsics, views[0].T_world_camera, (120, 160)
    found, wanted = (one.raycast(*camera).depth for one in (volume, unbounded))
    assert np.array_equal(found, wanted)
    assert (found > 0).sum() > 50


def test_meshes_and_checkpoints_are_the_same_in_no_more_memory(
    folder: Path, views: list[Keyframe], unbounded: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_regularizer, "BATCH", 256)
    volume, whole = bounded(folder, views), unbounded.extract_mesh()
    mesh = volume.extract_mesh()
    assert unnamed_files_rss(folder) <= MEMORY + BESIDE
    for name in ("vertices", "faces", "normals", "colors"):
        assert getattr(mesh, name).tobytes() == getattr(whole, name).tobytes(), name
    saved = volume.save(folder / "map.tsf")
    assert unnamed_files_rss(folder) <= MEMORY + BESIDE
    assert saved.read_bytes() == unbounded.save(folder / "other.tsf").read_bytes()
    del volume
    again = Volume.load(saved, memory_bytes=MEMORY, cache=folder)
    assert unnamed_files_rss(folder) <= 2 * MEMORY + BESIDE  # of the first one, parts may still be there
    again.integrate(views[0])
    assert again.map_hash() == volume_of([*views, views[0]], voxel_size=VOXEL).map_hash()


def test_a_full_disk_budget_rejects_the_keyframe_and_keeps_the_map(
    folder: Path, views: list[Keyframe]
) -> None:
    first = volume_of(views[:2], voxel_size=VOXEL)
    cache = CacheConfig(folder=str(folder), disk_bytes=first.stats().bytes)
    volume = Volume(VOXEL, threads=2, memory_bytes=MEMORY, cache=cache)
    for view in views[:2]:
        volume.integrate(view)
    with pytest.raises(MapFull, match=r"disk_bytes = \d+ bytes on the disk, which are \d+ blocks; it has"):
        volume.integrate(views[2])
    assert volume.map_hash() == first.map_hash()
    saved = volume.save(folder / "map.tsf")
    smaller = CacheConfig(folder=str(folder), disk_bytes=1 << 20, min_free_bytes=1 << 60)
    opened = Volume.load(saved, memory_bytes=MEMORY, cache=smaller)  # one that is larger opens, and is full
    assert opened.map_hash() == first.map_hash()
    with pytest.raises(MapFull):
        opened.integrate(views[2])
    opened.integrate(views[0])


def test_a_full_disk_rejects_the_keyframe_and_keeps_the_map(
    folder: Path, views: list[Keyframe], monkeypatch: pytest.MonkeyPatch
) -> None:
    volume = Volume(VOXEL, threads=2, memory_bytes=MEMORY, cache=folder)
    volume.integrate(views[0])
    before = volume.map_hash()
    with monkeypatch.context() as patched:
        patched.setattr(os, "posix_fallocate", refuse(errno.ENOSPC))
        with pytest.raises(MapFull, match=r"no room for .* MB more of the map in .*: No space left"):
            volume.integrate(views[5])
    assert volume.map_hash() == before
    volume.integrate(views[5])


def test_a_folder_that_cannot_hold_blocks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidConfig, match="cannot hold blocks that are not in memory: No such file"):
        Volume(VOXEL, memory_bytes=MEMORY, cache=tmp_path / "none")
    monkeypatch.setattr(durable_files, "is_in_memory", lambda _: True)
    with pytest.raises(InvalidConfig, match="is a RAM disk"):
        Volume(VOXEL, memory_bytes=MEMORY, cache=tmp_path)
    monkeypatch.setattr(process, "shared_rss_bytes", lambda: 0)
    with pytest.raises(InvalidConfig, match="memory_bytes needs Linux and its /proc"):
        Volume(VOXEL, memory_bytes=MEMORY, cache=tmp_path)
    with pytest.raises(InvalidConfig, match="memory_bytes must be"):
        Volume(VOXEL, memory_bytes=0)


def test_a_ram_disk_is_recognised() -> None:
    if not Path("/dev/shm").is_dir():
        pytest.skip("this machine has no RAM disk")
    assert durable_files.is_in_memory(Path("/dev/shm"))
    assert not durable_files.is_in_memory(Path("/proc"))


def test_the_blocks_changed_longest_ago_leave_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = FileArray((512,), np.int64, 6 * GROUP, folder)
    gone: list[tuple[int, int]] = []
    usual = rows.let_go

    def let_go(first: int, end: int) -> None:
        gone.append((first // GROUP, end // GROUP))
        usual(first, end)

    monkeypatch.setattr(rows, "let_go", let_go)
    residency = Residency([rows])
    group = GROUP * 4096  # bytes
    versions = np.repeat(np.array([5, 1, 2, 9, 1, 0], np.int32), GROUP)
    rows.array[: 5 * GROUP] = 7
    residency.keep_within(5 * group, versions)
    assert gone == []
    residency.keep_within(3 * group, versions)
    assert gone == [(1, 3), (4, 5)]
    assert unnamed_files_rss(folder) == 2 * group
    assert rows.array.sum() == 5 * GROUP * 512 * 7  # they come back


def test_without_the_systems_page_table_the_newest_blocks_stay(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = FileArray((512,), np.int64, 6 * GROUP, folder)
    rows.array[: 6 * GROUP] = 1
    residency = Residency([rows])
    monkeypatch.setattr(os, "pread", refuse(errno.EACCES))
    monkeypatch.setattr(process, "shared_rss_bytes", lambda: 1 << 40)
    residency.keep_within(2 * GROUP * 4096, np.repeat(np.arange(6, dtype=np.int32), GROUP))
    assert unnamed_files_rss(folder) == GROUP * 4096


@pytest.mark.parametrize("seed", range(3))
def test_whatever_comes_and_goes_the_map_is_that_of_what_remains(folder: Path, seed: int) -> None:
    views, random = sphere_views(0.5, 8), np.random.default_rng(seed)
    volume, held = Volume(0.01, threads=2, memory_bytes=2 << 20, cache=folder), [views[0]]
    volume.integrate(views[0])
    for act in random.choice(["add", "add", "move", "release", "load", "mesh"], 14):
        if act == "move":
            volume.retract(held.pop(int(random.integers(len(held)))))
        if act in ("add", "move"):
            held.append(views[int(random.integers(len(views)))])
            volume.integrate(held[-1])
        elif act == "release":
            volume.release_empty()
        elif act == "load":
            saved = volume.save(folder / "map.tsf")
            volume = Volume.load(saved, memory_bytes=2 << 20, cache=folder)
        else:
            volume.extract_mesh(blocks=volume.cells_to_mesh(volume.take_dirty()))
    fresh = volume_of(held, voxel_size=0.01)
    assert (volume.map_hash(), volume.color_hash()) == (fresh.map_hash(), fresh.color_hash())
    mesh, expected = volume.extract_mesh(), fresh.extract_mesh()
    assert mesh.vertices.tobytes() == expected.vertices.tobytes()
    assert mesh.faces.tobytes() == expected.faces.tobytes()
