# SPDX-License-Identifier: MIT
"""Surfaces: a run's map measured and drawn, and λ and support swept over three sensors.

    python lab/paper/paper_surface.py JOB.json OUT.json

Fusion alone is judged with true poses. How far a run's own map is off is another figure, and mostly drift.
"""

import dataclasses
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.bench.peers import Open3D, VDBFusion
from lab.evaluation import surface_error
from lab.evaluation.known_surfaces import COMPLETE_WITHIN, KnownSurface, WorldSurface, measure
from lab.paper.paper_runs import MAPS
from lab.paper.paper_worlds import INDOORS, PaperWorld
from lab.worlds.named_worlds import open_world
from tsfusion.core import process
from tsfusion.core.config import SENSORS, VolumeConfig, make_settings
from tsfusion.datasets import Synthetic
from tsfusion.geometry.keyframe import Keyframe, points_world
from tsfusion.geometry.mesh import Mesh

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

SEEN_BY = 4  # clean samples in a cell
PICTURE = (1200, 750)
PEERS = ("vdbfusion", "open3d")
_BACK, _ABOVE, _PITCH = 6.0, 2.0, 10.0  # metres and degrees: a view over the camera's shoulder
_INDOORS = 0.25  # times as near


class MapJob(Struct, frozen=True, kw_only=True, tag="map"):
    """Measure and draw the map of a live run.

    Attributes:
        map, poses: files of the run.
        pictures: path of the pictures, without `-whole.png` and `-detail.png`.
    """

    world: PaperWorld
    map: str
    poses: str
    pictures: str


class SweepJob(Struct, frozen=True, kw_only=True, tag="sweep"):
    """Fuse the same keyframes, at their true poses, with many settings.

    Attributes:
        keyframes: so many, evenly spread over `stretch` frames.
        smoothness, supports: λ and half-widths in voxels; each with each.
        weights: samples that a voxel needs; the whole maps are meshed with each, besides the sensor's own.
        peers: of the other systems, those to run too.
    """

    world: PaperWorld
    keyframes: int
    stretch: int
    smoothness: tuple[float, ...]
    supports: tuple[float, ...]
    weights: tuple[float, ...] = ()
    peers: tuple[str, ...] = ()


def measure_map(job: MapJob) -> dict[str, Any]:
    """Error of a run's map against the known surface, as the run placed it, and its pictures."""
    from tsfusion.tsdf.volume import Volume

    mesh = Volume.load(job.map).extract_mesh()
    with np.load(job.poses, allow_pickle=False) as kept:
        indices, poses, truth = kept["indices"], kept["poses"], kept["truth"]
    found: dict[str, Any] = {"triangles": len(mesh.faces)}
    if not len(mesh.faces) or not len(poses):
        return found
    _draw(mesh, poses, job.pictures, is_indoors=job.world.sensor in INDOORS)
    if not job.world.is_rendered or not np.isfinite(truth).all():
        return found
    shown = indices[:: max(1, len(indices) // 60)]
    surface = known_surface(job.world, [int(index) for index in shown])
    # A front end begins at the origin: there its map is as the true path begins.
    T = truth[0] @ np.linalg.inv(poses[0])
    moved = dataclasses.replace(
        mesh,
        vertices=(mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
        normals=(mesh.normals @ T[:3, :3].T).astype(np.float32),
    )
    return {**found, **measure(moved, surface, job.world.voxel_size)}


def _draw(mesh: Mesh, poses: NDArray[np.float64], path: str, *, is_indoors: bool) -> None:
    """Draw the whole map from above, and a part of it over the camera's shoulder."""
    from tsfusion.kernels.base import runtime
    from tsfusion.pipelines.maps import mesh_preview
    from tsfusion.pipelines.maps.mesh_preview import PreviewCamera

    runtime.start()
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    whole = mesh_preview.choose_camera(dataclasses.replace(mesh), up, aspect=PICTURE[0] / PICTURE[1])
    near = _INDOORS if is_indoors else 1.0
    back = np.eye(4)
    turn = np.radians(-_PITCH)
    back[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    back[:3, 3] = (0, -_ABOVE * near, -_BACK * near)
    detail = PreviewCamera(poses[len(poses) // 2] @ back)
    for name, camera in (("whole", whole), ("detail", detail)):
        drawn = mesh_preview.picture(mesh, camera, *PICTURE, up=up)
        mesh_preview.write_png(drawn, Path(f"{path}-{name}.png"))


def sweep(job: SweepJob) -> list[dict[str, Any]]:
    """A row a setting: λ, support, F-score, completeness, error; then the whole maps, then other systems."""
    dataset, world = job.world.open(), job.world
    chosen = np.unique(np.linspace(0, min(job.stretch, len(dataset)) - 1, job.keyframes).round().astype(int))
    keyframes = [dataset[int(index)] for index in chosen]
    surface = known_surface(world, [int(index) for index in chosen])
    rows = []
    for settings in _settings(job):
        mesh = _fused(keyframes, world, settings).extract_mesh()
        rows.append(_row(world, "ray", settings, measure(mesh, surface, world.voxel_size)))
    for name, settings in MAPS.items():
        volume = _fused(keyframes, world, settings)
        for weight in (None, *job.weights):
            found = measure(volume.extract_mesh(weight), surface, world.voxel_size)
            rows.append(_row(world, name, {"min_weight": weight}, found))
    for name in job.peers:
        rows.append(_row(world, name, {}, measure(_peer(name, keyframes, world), surface, world.voxel_size)))
    return rows


def _settings(job: SweepJob) -> Iterator[dict[str, Any]]:
    """Settings of each row of per-ray integration alone."""
    for support in job.supports:
        width = {"min_support": support, "max_support": support, "min_behind": support, "surface": "raw"}
        yield {"regularizer": "off", "smoothness": 0.0, **width}
        for smoothness in job.smoothness:
            yield {"regularizer": "ray", "smoothness": smoothness, **width}


def _fused(keyframes: list[Keyframe], world: PaperWorld, settings: dict[str, Any]) -> "Volume":
    from tsfusion.tsdf.volume import Volume

    config = {"voxel_size": world.voxel_size, "sensor": world.sensor, "color": False, **settings}
    volume = Volume(make_settings(VolumeConfig, config))
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return volume


def _peer(name: str, keyframes: list[Keyframe], world: PaperWorld) -> Mesh:
    truncation = 10.0 if world.sensor == "stereo" else 4.0
    kind: Any = {"vdbfusion": VDBFusion, "open3d": Open3D}[name]
    system = kind(world.voxel_size, max_range=SENSORS[world.sensor].max_range, truncation=truncation)
    for keyframe in keyframes:
        system.integrate(keyframe)
    mesh: Mesh = system.extract_mesh()
    return mesh


def _row(world: PaperWorld, method: str, settings: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    return {
        "world": world.name, "sensor": world.sensor, "method": method,
        "smoothness": settings.get("smoothness"), "support": settings.get("min_support"),
        "min_weight": settings.get("min_weight"),
        "mean_mm": found["accuracy_mm"]["mean"], "p95_mm": found["accuracy_mm"]["p95"],
        "precision": found["precision"], "completeness": found.get("completeness"),
        "f_score": found.get("f_score"), "normal_deg": found["normal_deg"]["median"],
    }  # fmt: skip


def known_surface(world: PaperWorld, indices: list[int]) -> KnownSurface:
    """The surface of a rendered world, and the part of it that some frames saw without noise."""
    options = {**world.options, "noise": False} if _takes_noise(world) else world.options
    clean: Any = open_world(world.source, **options)
    reach = SENSORS[world.sensor].max_range
    shown = []
    for index in indices:
        points, T = _clean_points(clean, index)
        shown.append(points[np.linalg.norm(points - T[:3, 3], axis=1) < reach])
    every = np.concatenate(shown)
    seen = surface_error.one_per_cell(every, COMPLETE_WITHIN * world.voxel_size, at_least=SEEN_BY)
    return WorldSurface(clean.world, seen, edges=False)


def _takes_noise(world: PaperWorld) -> bool:
    return isinstance(open_world(world.source, **world.options), Synthetic)


def _clean_points(clean: Any, index: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) world points that a frame shows without noise, and its pose."""
    if isinstance(clean, Synthetic):
        keyframe = clean[index]
    else:  # a drive, which knows its depth
        depth, T = clean.depth(index).astype(np.float32), clean.pose(index)
        keyframe = Keyframe(depth=depth, depth_scale=1.0, T_world_camera=T, intrinsics=clean.intrinsics)
    return points_world(keyframe), keyframe.T_world_camera


def main() -> int:
    process.on_parent_end(signal.SIGKILL)
    job = msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=MapJob | SweepJob)
    found: Any = measure_map(job) if isinstance(job, MapJob) else sweep(job)
    Path(sys.argv[2]).write_bytes(msgspec.json.encode(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
