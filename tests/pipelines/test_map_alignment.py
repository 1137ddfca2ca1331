# SPDX-License-Identifier: MIT
"""Maps of different frames, aligned and merged, or refused with a reason."""

import json
import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from command_processes import Here, python
from journaled_maps import recorded, unknown_start

from tsfusion import (
    AlignmentRefused,
    Keyframe,
    MissingDependency,
    Volume,
    VolumeConfig,
    journal,
    open_dataset,
)
from tsfusion.evaluation import surface_fit
from tsfusion.evaluation.surface_fit import SurfaceRegistration
from tsfusion.geometry import se3
from tsfusion.journal import state_folder
from tsfusion.pipelines.maps import map_alignment
from tsfusion.pipelines.maps.map_alignment import AlignedMap, open_map

CONFIG = VolumeConfig(voxel_size=0.05, threads=1)
START = unknown_start(1)  # T_b_a


@cache
def room() -> list[Keyframe]:
    dataset = open_dataset("synthetic:room")
    return [dataset[i] for i in range(0, 40, 2)]


def elsewhere(keyframes: list[Keyframe]) -> list[Keyframe]:
    return [replace(one, T_world_camera=START @ one.T_world_camera) for one in keyframes]


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two overlapping halves of a room, the second from an unknown start."""
    folder = tmp_path_factory.mktemp("halves")
    second = elsewhere(room()[8:])
    return recorded(folder / "a", room()[:13], CONFIG), recorded(folder / "b", second, CONFIG)


@pytest.fixture(scope="module")
def maps(halves: tuple[Path, Path]) -> tuple[AlignedMap, AlignedMap]:
    a, b = halves
    return open_map(a), open_map(b)


class Given(SurfaceRegistration):
    """Finds what a test says, and refines nothing: what stands around the library runs without it."""

    found: ClassVar[list[Any]] = []

    def __init__(self, *_: Any) -> None:
        pass

    def candidates(self) -> list[Any]:
        return self.found

    def refined(self, T_a_b: Any, *_: Any) -> Any:
        return T_a_b


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> type[Given]:
    monkeypatch.setattr(map_alignment, "SurfaceRegistration", Given)
    monkeypatch.setattr(Given, "found", [se3.inverse(START)])
    monkeypatch.setattr(surface_fit, "check_installed", lambda: None)
    return Given


pytest.importorskip("scipy")


def test_halves_from_unknown_starts_are_one_room(maps: tuple[AlignedMap, AlignedMap]) -> None:
    found = map_alignment.align(*maps)
    wrong = se3.nearest(START @ np.array(found.T_a_b))
    assert se3.angle(wrong) < np.radians(0.2)
    at = maps[1].mesh.vertices.astype(np.float64)
    off = se3.apply(np.array(found.T_a_b), at) - se3.apply(se3.inverse(START), at)
    assert np.linalg.norm(off, axis=1).mean() < 0.2 * CONFIG.voxel_size
    assert found.overlap > 0.4
    assert found.contradicted < 0.02
    assert found.tilt_deg is not None


def test_the_search_ends_where_all_agrees(
    maps: tuple[AlignedMap, AlignedMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two maps that are the same every sample is good: to judge them all takes minutes."""
    rigid, calls = surface_fit._rigid, list[int]()
    monkeypatch.setattr(surface_fit, "_rigid", lambda a, b: (calls.append(len(a)), rigid(a, b))[1])
    surface = surface_fit.SampledSurface(maps[0].mesh, 0.1)
    found = SurfaceRegistration(surface, surface).candidates()
    assert sum(calls) < 3000
    assert all(np.allclose(T, np.eye(4), atol=1e-6) for T in found)
    assert len(found) == 4


@pytest.mark.usefixtures("given")
@pytest.mark.parametrize(("drift_mm", "least", "most"), [(0, 0, 12), (60, 25, 120), (100, 42, 200)])
def test_the_error_covers_a_drift_that_a_robust_fit_leaves_out(
    drift_mm: float, least: float, most: float
) -> None:
    """The fit's own residual is bounded by what counts as one surface, whatever the drift."""
    maps = []
    for name, moving in (("a", 0.0), ("b", drift_mm / 1000)):
        volume = Volume(CONFIG)
        for i, keyframe in enumerate(room()):
            T = keyframe.T_world_camera.copy()
            T[:3, 3] += moving * i / len(room()) * np.array((0.8, 0.6, 0))
            volume.integrate(replace(keyframe, T_world_camera=T if name == "a" else START @ T))
        maps.append(map_alignment.map_of_volume(name, volume))
    found = map_alignment.align(*maps)
    assert least <= found.error_mm <= most
    assert found.rmse_mm < max(12, 0.7 * found.error_mm)


@pytest.mark.usefixtures("given")
def test_what_is_merged_is_the_map_of_both(halves: tuple[Path, Path], here: Here, tmp_path: Path) -> None:
    a, b = halves
    done = here("map", "align", a, b, "--out", "c.tsf", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert np.allclose(said["alignment"]["T_a_b"], se3.inverse(START))
    assert said["alignment"]["rmse_mm"] < 0.2e3 * CONFIG.voxel_size
    both = Volume(CONFIG)
    for keyframe in room()[:13]:
        both.integrate(keyframe)
    for keyframe in elsewhere(room()[8:]):
        T = np.array(said["alignment"]["T_a_b"]) @ keyframe.T_world_camera
        both.integrate(replace(keyframe, T_world_camera=T))
    assert Volume.load(tmp_path / "c.tsf").map_hash() == both.map_hash() == said["merged"]["map_hash"]
    assert (said["merged"]["exact"], said["merged"]["keyframes"]) == (True, 25)
    done = here("map", "align", "c.tsf", b, "--out", "d.tsf")
    assert (done.returncode, "was merged into that map before" in done.stderr) == (1, True)


@pytest.mark.usefixtures("given")
def test_what_damage_has_cost_is_told_at_the_end(
    halves: tuple[Path, Path], here: Here, tmp_path: Path
) -> None:
    a, b = halves[0], tmp_path / "b"
    shutil.copytree(halves[1], b)
    path = next(b.rglob("000001.mcap"))
    last = list(journal.records(path))[-1]
    content = bytearray(path.read_bytes())
    content[last.position.offset + 700] ^= 16
    path.write_bytes(content)
    done = here("map", "align", a, b, "--out", "c.tsf", "--json")
    assert (done.returncode, "the map lacks 1 keyframe or more" in done.stderr) == (1, True)
    said = json.loads(done.stdout)["merged"]
    assert Volume.load(tmp_path / "c.tsf").map_hash() == said["map_hash"]


def test_a_map_is_not_merged_with_itself(
    given: type[Given], halves: tuple[Path, Path], here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(given, "found", [np.eye(4)])
    done = here("map", "align", halves[0], halves[0], "--out", "c.tsf")
    assert (done.returncode, "both maps hold 13 keyframes of session" in done.stderr) == (1, True)


@pytest.mark.usefixtures("given")
def test_without_a_journal_the_surface_is_resampled(
    maps: tuple[AlignedMap, AlignedMap], here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_alignment._MapPair, "turned", lambda *_: [])  # it looks much alike by four sides
    for name, one in zip("ab", maps, strict=True):
        one.volume.save(tmp_path / f"{name}.tsf")
    done = here("map", "align", "a.tsf", "b.tsf", "--out", "c.tsf")
    assert done.returncode == 0, done.stderr
    assert "(b.tsf has no journal: its surface was resampled)" in done.stdout
    assert "against it 0." in done.stdout
    merged, alone = Volume.load(tmp_path / "c.tsf"), maps[0]
    extent = [np.ptp(one.vertices, axis=0) for one in (merged.extract_mesh().without_islands(), alone.mesh)]
    assert (extent[0] >= extent[1] - CONFIG.voxel_size).all()
    new = maps[1].mesh.vertices @ se3.inverse(START)[:3, :3].T + se3.inverse(START)[:3, 3]
    distance = merged.signed_distance(new)
    assert np.isfinite(distance).mean() > 0.99
    assert np.nanmedian(np.abs(distance)) < 0.75 * CONFIG.voxel_size  # of the voxel, not of the point


def refused(maps: tuple[AlignedMap, AlignedMap]) -> str:
    with pytest.raises(AlignmentRefused) as error:
        map_alignment.align(*maps)
    return str(error.value)


def test_wrong_places_are_refused(given: type[Given], maps: tuple[AlignedMap, AlignedMap]) -> None:
    away, right = se3.transform(np.eye(3), (0.0, 0.0, 20.0)), se3.inverse(START)
    given.found = [away @ right]
    assert "share too little: at best 0%" in refused(maps)
    given.found = [se3.exp(np.array((0.9, 0.5, 0.0, 0.0, 0.0, 0.3))) @ right]
    assert "share too little" in refused(maps) or "looked through" in refused(maps)
    given.found = []
    assert "no part of" in refused(maps)
    given.found = [right @ se3.exp(np.array((0, 0, 0, np.pi, 0, 0.0)))]  # upside down
    assert "no part of" in refused(maps)


def cube(size: float, config: VolumeConfig, *, faces: int = 3) -> AlignedMap:
    """A box's inside, all of whose walls look alike, as points."""
    volume = Volume(config)
    u, v = (x.ravel() for x in np.mgrid[-1 : 1 : config.voxel_size / 4, -1 : 1 : config.voxel_size / 4])
    for axis in range(faces):
        for side in (-1.0, 1.0):
            points = np.insert(np.stack([u, v], 1), axis, side, axis=1).astype(np.float32) * size
            volume.integrate(Keyframe(points=points, T_world_camera=np.eye(4), sensor="scanner"))
    return map_alignment.map_of_volume("box", volume)


def test_a_place_that_looks_alike_from_several_sides_is_refused(given: type[Given]) -> None:
    box = cube(1.0, VolumeConfig(voxel_size=0.05, sensor="scanner", threads=1))
    given.found = [np.eye(4)]
    assert "fits box in more than one way, 90° and" in refused((box, box))


def test_what_can_slide_is_refused(given: type[Given]) -> None:
    corridor = cube(1.0, VolumeConfig(voxel_size=0.05, sensor="scanner", threads=1), faces=2)
    given.found = [np.eye(4)]
    assert "can slide along box: what they share is too flat or too even" in refused((corridor, corridor))


@pytest.mark.usefixtures("given")
def test_maps_that_cannot_be_aligned(here: Here, maps: tuple[AlignedMap, AlignedMap]) -> None:
    empty = replace(maps[0], mesh=Volume(CONFIG).extract_mesh(), name="empty")
    assert "empty has no surface (yet)" in refused((empty, maps[1]))
    done = here("map", "align", "nowhere", "b.tsf")
    assert (done.returncode, "nowhere does not exist; expected a map" in done.stderr) == (1, True)


def test_without_scipy_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_fit, "find_spec", lambda _name: None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[align\]' in your clone"):
        surface_fit.check_installed()


def test_equal_maps_align_equally_to_the_bit(maps: tuple[AlignedMap, AlignedMap], tmp_path: Path) -> None:
    """In each process, with any number of threads."""
    program = (
        "import sys, numpy as np\n"
        "from tsfusion.evaluation.surface_fit import SampledSurface, SurfaceRegistration\n"
        "from tsfusion.geometry.mesh import Mesh\n"
        "meshes = [Mesh(**np.load(path)) for path in sys.argv[1:]]\n"
        "made = SurfaceRegistration(*(SampledSurface(one, 0.1) for one in meshes))\n"
        "print([made.refined(T).tolist() for T in made.candidates()])\n"
    )
    files = [tmp_path / f"{number}.npz" for number in range(2)]
    for file, one in zip(files, maps, strict=True):
        np.savez(file, vertices=one.mesh.vertices, faces=one.mesh.faces, normals=one.mesh.normals)
    found = {
        python(program, *files, env={**os.environ, "OPENBLAS_NUM_THREADS": threads}).stdout
        for threads in ("1", "2")
    }
    assert len(found) == 1
    assert len(found.pop()) > 100


@pytest.mark.nightly
@pytest.mark.slow
def test_two_rooms_are_refused_and_one_is_found(data: Any, tmp_path: Path) -> None:
    config = VolumeConfig(voxel_size=0.04, threads=1)
    kitchen, office = (open_dataset(str(data(name))) for name in ("7scenes/redkitchen", "hololens"))
    parts = [[kitchen[i] for i in range(first, first + 60, 3)] for first in (0, 42)]
    for name, keyframes in (
        ("a", parts[0]),
        ("b", elsewhere(parts[1])),
        ("c", [office[i] for i in range(40)]),
    ):
        recorded(tmp_path / name, keyframes, config)
    a, b, c = (open_map(tmp_path / name) for name in "abc")
    found = map_alignment.align(a, b)
    off = se3.apply(START @ np.array(found.T_a_b), b.mesh.vertices) - b.mesh.vertices
    assert np.linalg.norm(off, axis=1).mean() < config.voxel_size
    with pytest.raises(AlignmentRefused):
        map_alignment.align(a, c)


def test_signed_distance_is_that_of_the_voxel() -> None:
    volume = Volume(voxel_size=0.05, sensor="scanner", threads=1)
    u, v = (x.ravel() for x in np.mgrid[-0.5:0.5:0.01, -0.5:0.5:0.01])
    wall = np.stack([u, v, np.full_like(u, 1.0)], 1).astype(np.float32)
    origins = wall - np.array((0, 0, 0.5), np.float32)
    volume.integrate(Keyframe(points=wall, origins=origins, T_world_camera=np.eye(4)))
    z = np.array([0.925, 0.975, 1.025, 1.075])  # middles of voxels
    points = np.stack([np.full(4, 0.025), np.full(4, 0.025), z], 1)
    assert volume.signed_distance(points) == pytest.approx(1.0 - z, abs=0.002)
    far = np.array([[0.0, 0, 0], [np.nan, 0, 0], [1e9, 0, 0]])
    assert np.isnan(volume.signed_distance(far)).all()
    assert (state_folder.MAP_FILE, len(volume.signed_distance(np.empty((0, 3))))) == ("map.tsf", 0)
