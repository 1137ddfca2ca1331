# SPDX-License-Identifier: MIT
"""Two overlapping halves of a recording, the second from an unknown start, aligned and merged.

    python lab/evaluation/alignment.py RECORDING [--voxel-size 0.02] [--overlap 0.12] [--seeds 3]
                                                  [--picture PNG]
    python lab/evaluation/alignment.py RECORDING --other RECORDING

Every other frame is fused; what the frames between them measured is the reference. Prints one JSON line a
seed: overlap and contradictions, the mean distance of the second half from where the recording's own poses
have it, and F-scores (percent, within a voxel and within 5 cm) against the reference of the merged map and
of one scan with the recording's poses. With --other: that two rooms are refused.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from tsfusion import AlignmentRefused, Keyframe, Volume, open_dataset
from tsfusion.core.config import SensorName, VolumeConfig
from tsfusion.evaluation.surface_fit import nearest
from tsfusion.geometry import se3
from tsfusion.pipelines.maps import map_alignment, mesh_preview

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from journaled_maps import recorded, unknown_start

from lab.evaluation import surface_error


def measured(keyframes: list[Keyframe], most: float) -> np.ndarray:
    """(n, 3) what depth keyframes measured, in the world, one point a centimetre."""
    found = []
    for one in keyframes:
        assert one.intrinsics is not None
        K, v, u = one.intrinsics, *np.mgrid[: one.shape[0] : 4, : one.shape[1] : 4]
        z = one.measurement[v, u] * (one.depth_scale if one.measurement.dtype == np.uint16 else 1.0)
        points = np.dstack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z])[(z > 0.3) & (z < most)]
        found.append(se3.apply(one.T_world_camera, points))
    return surface_error.one_per_cell(np.vstack(found), 0.01, at_least=2)


def f_scores(volume: Volume, reference: np.ndarray, tolerances: tuple[float, ...]) -> list[float]:
    """Percent: harmonic mean of precision and completeness within each tolerance, metres."""
    points = volume.extract_mesh().vertices.astype(np.float64)
    there, back = (nearest(x, y)[0] for x, y in ((points, reference), (reference, points)))
    within = partial(surface_error.percent_within, there), partial(surface_error.percent_within, back)
    return [round(surface_error.f_score(*(share(one) for share in within)), 2) for one in tolerances]


def measure(arguments: argparse.Namespace, seed: int, folder: Path) -> dict[str, Any]:
    """Align and merge the halves of a recording; one line of the report."""
    dataset = open_dataset(arguments.recording)
    config = VolumeConfig(voxel_size=arguments.voxel_size, sensor=cast(SensorName, dataset.sensor))
    keyframes = [dataset[i] for i in range(0, len(dataset), 2)]
    half, common = len(keyframes) // 2, round(arguments.overlap * len(keyframes) / 2)
    first, second = keyframes[: half + common], keyframes[half - common :]
    T_b_a = unknown_start(seed)
    moved = [replace(one, T_world_camera=T_b_a @ one.T_world_camera) for one in second]
    a, b = (
        map_alignment.open_map(recorded(folder / name, part, config))
        for name, part in (("a", first), ("b", moved))
    )
    began = time.process_time()
    found = map_alignment.align(a, b)
    seconds = time.process_time() - began
    T_a_b, at = np.array(found.T_a_b), b.mesh.vertices.astype(np.float64)
    off = np.linalg.norm(se3.apply(T_a_b, at) - se3.apply(se3.inverse(T_b_a), at), axis=1)
    one_scan = Volume(config)
    for keyframe in (*first, *second):
        one_scan.integrate(keyframe)
    assert a.volume is not None
    map_alignment.merge(a.volume, b, T_a_b)
    if arguments.picture is not None:
        mesh_preview.render(a.volume.extract_mesh(), arguments.picture)
    between = [dataset[i] for i in range(1, len(dataset), 2)]
    reference = measured(between, config.checked_model().max_range)
    tolerances = (arguments.voxel_size, 0.05)
    return {
        "recording": Path(arguments.recording).name,
        "seed": seed,
        "keyframes": [len(first), len(moved)],
        "overlap": found.overlap,
        "rmse_mm": found.rmse_mm,
        "contradicted": found.contradicted,
        "contradicted_alone": found.contradicted_alone,
        "off_mm": round(1e3 * float(off.mean()), 2),
        "off_deg": round(float(np.degrees(se3.angle(se3.nearest(T_b_a @ T_a_b)))), 3),
        "f_aligned": f_scores(a.volume, reference, tolerances),
        "f_one_scan": f_scores(one_scan, reference, tolerances),
        "cpu_s": round(seconds, 1),
    }


def refuse(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Try to align two rooms that have nothing in common."""
    made = []
    for name, recording in (("a", arguments.recording), ("b", arguments.other)):
        dataset = open_dataset(recording)
        config = VolumeConfig(voxel_size=arguments.voxel_size, sensor=cast(SensorName, dataset.sensor))
        path = recorded(folder / name, (dataset[i] for i in range(len(dataset))), config)
        made.append(map_alignment.open_map(path))
    line = {"recording": arguments.recording, "other": arguments.other}
    try:
        return {**line, "aligned": msgspec.to_builtins(map_alignment.align(*made))}
    except AlignmentRefused as error:
        return {**line, "refused": str(error)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("--other", help="a recording of another room, which must be refused")
    parser.add_argument("--voxel-size", type=float, default=0.02)
    parser.add_argument(
        "--overlap", type=float, default=0.12, help="share of the keyframes that both halves have"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--picture", type=Path, help="PNG of the merged map")
    arguments = parser.parse_args()
    if arguments.other:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(refuse(arguments, Path(folder))), flush=True)
        return
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(measure(arguments, seed, Path(folder))), flush=True)


if __name__ == "__main__":
    main()
