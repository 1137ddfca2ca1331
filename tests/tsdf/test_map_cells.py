# SPDX-License-Identifier: MIT
"""The cells of a map some at a time: all are its mesh, and those after a version are what changed."""

from typing import Any

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from numpy.typing import NDArray

from tsfusion import Volume, VolumeConfig
from tsfusion.core.config import Surface
from tsfusion.tsdf.store import block_store
from tsfusion.tsdf.store.block_store import cells_of
from tsfusion.tsdf.surface import changed_cells
from tsfusion.tsdf.surface.changed_cells import ChangedCells
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes

VOXEL = 0.03
SURFACES: tuple[Surface, ...] = ("raw", "normal", "field")
Cell = tuple[int, int, int]
Triangles = dict[Cell, set[bytes]]


def triangles_of(found: CellMeshes) -> Triangles:
    """The triangles of each cell, as the bytes of their corners."""
    corners = found.mesh.vertices[found.mesh.faces].reshape(-1, 9)
    first, last = found.first_face[:-1].tolist(), found.first_face[1:].tolist()
    return {
        (x, y, z): {one.tobytes() for one in corners[i:j]}
        for (x, y, z), i, j in zip(found.cells.tolist(), first, last, strict=True)
    }


def taken(
    versions: ChangedCells, version: int, most: int, *, refine: bool = False
) -> tuple[Triangles, set[tuple[int, int, int]], int]:
    """All cells after a version, so many at a time; those that are refined; and the last version."""
    cells: Triangles = {}
    refined: set[Cell] = set()
    while True:
        found = versions.since(version, most, refine=refine)
        new = triangles_of(found)
        assert len(new) == len(found.cells)
        assert not new.keys() & cells.keys()
        assert found.until > version or not new
        cells |= new
        refined |= {cell for cell, its in zip(new, found.is_refined.tolist(), strict=True) if its}
        version = found.until
        if not found.more:
            return cells, refined, version


@pytest.fixture(scope="module")
def volume() -> Volume:
    return volume_of(sphere_views(0.6, 3), voxel_size=VOXEL)


def meshed(volume: Volume, surface: Surface, cells: NDArray[np.int32] | None = None) -> Triangles:
    return triangles_of(
        volume.surface.mesh_cells(volume.blocks().coordinates if cells is None else cells, surface)
    )


def of_surface(surface: Surface, views: Any) -> Volume:
    volume = Volume(VolumeConfig(voxel_size=VOXEL, surface=surface))
    for view in views:
        volume.integrate(view)
    return volume


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("most", [3, 50, 1000])
def test_cells_are_raw_first_and_come_again_once_refined(surface: Surface, most: int) -> None:
    volume = of_surface(surface, sphere_views(0.6, 3))
    versions = ChangedCells(volume.surface)
    cells, refined, until = taken(versions, 0, most)
    assert cells == meshed(volume, "raw")
    assert refined == (cells.keys() if surface == "raw" else set())
    assert taken(versions, until, most)[0] == {}
    while versions.refine_waits():
        versions.refine(40)
    cells, refined, again = taken(versions, until, most)
    if surface == "raw":
        assert (cells, again) == ({}, until)
        return
    assert refined == cells.keys() == meshed(volume, "raw").keys()
    if surface == "normal":
        assert cells == meshed(volume, "normal")


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("most", [3, 50, 1000])
def test_cells_that_nobody_has_come_once_and_refined(surface: Surface, most: int) -> None:
    views = sphere_views(0.6, 6)
    volume = of_surface(surface, views[:2])
    versions = ChangedCells(volume.surface)
    told = {**triangles_of(versions.since(0, most))}  # to another follower, raw
    untold, refined, until = taken(versions, versions.since(0, most).until, most, refine=True)
    assert refined == untold.keys() == meshed(volume, "raw").keys() - told.keys()
    volume.integrate(views[2])
    versions.follow()
    changed, refined, until = taken(versions, until, most, refine=True)
    assert refined == changed.keys()
    while versions.refine_waits():
        versions.refine(40)
    again, _, _ = taken(versions, until, most)
    if surface != "field":  # which may end elsewhere where it begins elsewhere
        assert {**told, **untold, **changed, **again} == meshed(volume, surface)
    assert {**told, **untold, **changed, **again}.keys() == meshed(volume, "raw").keys()


@pytest.mark.parametrize("surface", SURFACES)
def test_cells_after_a_version_are_those_that_changes_reach(surface: Surface) -> None:
    views = sphere_views(0.6, 6)
    volume = of_surface(surface, views[:2])
    versions = ChangedCells(volume.surface)
    volume.take_dirty()
    while versions.refine_waits():
        versions.refine(1000)
    before, _, until = taken(versions, 0, 1000)
    volume.integrate(views[2])
    volume.retract(views[0])
    dirty = volume.take_dirty()
    versions.follow()
    changed, refined, until = taken(versions, until, 9)
    assert changed.keys() == {tuple(one) for one in cells_of(dirty).tolist()} & meshed(volume, "raw").keys()
    assert changed.items() <= meshed(volume, "raw").items()
    if surface == "raw":
        assert {**before, **changed} == meshed(volume, "raw")
        return
    assert refined == set()
    while versions.refine_waits():
        versions.refine(1000)
    again, refined, _ = taken(versions, until, 1000)
    assert refined == again.keys() >= changed.keys()
    if surface == "normal":
        assert {**before, **again} == meshed(volume, "normal")


@pytest.mark.parametrize("work", ["around", "cells_of"])
def test_who_follows_goes_on_where_memory_ended(monkeypatch: pytest.MonkeyPatch, work: str) -> None:
    """Blocks were removed, and there was no memory to find the cells beside them."""

    def full(*_: Any, **__: Any) -> None:
        raise MemoryError

    views = sphere_views(0.6, 6)
    volume = of_surface("normal", views[:2])
    versions = ChangedCells(volume.surface)
    held, _, until = taken(versions, 0, 1000)
    volume.retract(views[1])
    assert volume.release_empty()
    volume.integrate(views[2])
    with monkeypatch.context() as patched:
        patched.setattr(changed_cells, work, full)
        with pytest.raises(MemoryError):
            versions.follow()
    versions.follow()
    assert versions.first <= until < versions.newest
    while versions.refine_waits():
        versions.refine(1000)
    assert taken(versions, 0, 1000)[0] == meshed(volume, "normal")
    held |= taken(versions, until, 1000)[0]
    there = meshed(volume, "normal")
    assert {cell: held[cell] for cell in there} == there
    assert not any(held[cell] for cell in held.keys() - there.keys())


def test_versions_say_when_a_block_changed(volume: Volume) -> None:
    cells = volume.blocks().coordinates
    own = volume.surface.cell_versions(cells)
    assert own.min() > 0
    assert own.max() == volume.version == 3
    absent = np.array([[900, 0, 0]], np.int32)
    assert volume.surface.cell_versions(absent).tolist() == [0]
    empty = volume.surface.mesh_cells(absent)
    assert (empty.first_face.tolist(), len(empty.mesh.faces)) == ([0, 0], 0)


def test_an_empty_map_has_no_cells() -> None:
    found = ChangedCells(Volume(VOXEL).surface).since(0, 10)
    assert (len(found.cells), found.until, found.more) == (0, 1, False)


def test_nothing_waits_to_be_refined_in_a_map_of_which_too_much_was_removed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(block_store, "MOST_REMOVED", 5)
    volume = of_surface("normal", sphere_views(0.6, 1))
    versions = ChangedCells(volume.surface)
    versions.refine(3)
    assert versions.refine_waits()
    volume.clear()
    versions.follow()
    assert not versions.refine_waits()
    volume.integrate(sphere_views(0.6, 1)[0])
    versions.refine(1000)
    assert taken(versions, 0, 1000)[0] == meshed(volume, "normal")
