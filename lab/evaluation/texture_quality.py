#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""How sharp a map's colours are: what it shows a camera against what that camera saw, one JSON line a method.

    python lab/evaluation/texture_quality.py DATASET                      # every fifth frame is held out
    python lab/evaluation/texture_quality.py DATASET --open3d --pictures views
    python lab/evaluation/texture_quality.py synthetic:room --voxel-size 0.04
    python lab/evaluation/texture_quality.py DATASET --choose             # settings chosen on other views

The frames held out are in no map and in no texture. All methods are compared on the same pixels: those where
the mesh lies within 5 cm of the depth measured there, at least two pixels from an edge of that depth, where
colour is registered to it. `psnr`, `ssim`: each held-out image is first moved onto what the method shows (six
numbers), and that is made as bright as the image (three factors), for each method by itself in the same way:
poses and exposures of single images are no property of a map. `_bright`: only brightness is fitted;
`_as_given`: nothing is. With `--choose` two sets of views are held out: the settings that are best on the one
(`choose`) are judged on the other (`judge`), beside the default ones.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.bench.peers import Open3D, surroundings
from lab.evaluation import view_colors
from tsfusion import Keyframe, Volume, open_dataset
from tsfusion.geometry.mesh import Mesh
from tsfusion.tsdf.texture import texturing
from tsfusion.tsdf.texture.texturing import TextureSettings

SHARPNESS = (1.0, 1.5, 3.0, 4.0)  # among which one is chosen, beside the default


class Chosen:
    """Some frames of a dataset as keyframes, read when they are asked for."""

    def __init__(self, dataset: Any, indices: NDArray[np.intp]) -> None:
        self._dataset, self._indices = dataset, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Keyframe:
        found: Keyframe = self._dataset[int(self._indices[index])]
        return found


def methods(volume: Volume, keyframes: Chosen, options: argparse.Namespace) -> Iterator[tuple[str, Mesh]]:
    """Each way to colour the surface."""
    plain = volume.extract_mesh()
    yield "voxel colour", plain
    ways: dict[str, dict[str, Any]] = {
        "texture": {},
        "texture, poses as given": {"align": False},
        "texture, exposures as given": {"even": False},
        "texture, both as given": {"align": False, "even": False},
    }
    chosen = ways if options.ablation else {"texture": {}}
    if options.choose:
        chosen = chosen | {f"texture, sharpness {power:g}": {"sharpness": power} for power in SHARPNESS}
    for name, changed in chosen.items():
        settings = TextureSettings(size=options.texture_size, texel=options.texel, **changed)
        made = texturing.textured(plain, keyframes, volume.config.voxel_size, settings)
        yield name, made
        if not changed:
            yield (
                "the texture's colours at the vertices",
                Mesh(made.vertices, made.faces, made.normals, made.colors),
            )
            if options.out is not None:
                made.save(options.out)
    if options.open3d:
        yield "Open3D VoxelBlockGrid", open3d_grid(volume, keyframes)
        if options.open3d_rounds:
            moved = partial(open3d_color_map, keyframes, rounds=options.open3d_rounds)
            yield "Open3D rigid colour map", moved(plain)
            yield "Open3D rigid colour map, mesh subdivided", moved(subdivided(plain))


def open3d_grid(volume: Volume, keyframes: Chosen) -> Mesh:
    """The mesh of Open3D's own map."""
    peer = Open3D(volume.config.voxel_size, max_range=volume.model.max_range, truncation=4.0, color=True)
    for keyframe in keyframes:
        peer.integrate(keyframe)
    found = peer.grid.extract_triangle_mesh(weight_threshold=peer.mesh_weight)
    colors = found.vertex.colors.numpy()
    scale = 255 if colors.max() <= 1.5 else 1
    return replace(peer.extract_mesh(), colors=np.rint(colors * scale).clip(0, 255).astype(np.uint8))


def open3d_color_map(keyframes: Chosen, mesh: Mesh, *, rounds: int) -> Mesh:
    """Our mesh with the colours of Open3D's colour map optimisation (Zhou and Koltun 2014), poses only."""
    import open3d

    o3d: Any = open3d
    images, cameras = [], []
    for keyframe in keyframes:
        assert keyframe.color is not None
        assert keyframe.depth is not None
        assert keyframe.intrinsics is not None
        height, width = keyframe.shape
        K = keyframe.intrinsics
        images.append(
            o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(np.ascontiguousarray(keyframe.color[..., ::-1])),
                o3d.geometry.Image(keyframe.depth),
                depth_scale=1 / keyframe.depth_scale,
                depth_trunc=10.0,
                convert_rgb_to_intensity=False,
            )
        )
        camera = o3d.camera.PinholeCameraParameters()
        camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(width, height, K.fx, K.fy, K.cx, K.cy)
        camera.extrinsic = np.linalg.inv(keyframe.T_world_camera)
        cameras.append(camera)
    trajectory = o3d.camera.PinholeCameraTrajectory()
    trajectory.parameters = cameras
    found, _ = o3d.pipelines.color_map.run_rigid_optimizer(
        mesh.to_open3d().to_legacy(), images, trajectory,
        o3d.pipelines.color_map.RigidOptimizerOption(maximum_iteration=rounds),
    )  # fmt: skip
    return replace(mesh, colors=np.rint(np.asarray(found.vertex_colors) * 255).astype(np.uint8))


def subdivided(mesh: Mesh) -> Mesh:
    """Each triangle as four: vertices half as far apart, as many as Open3D's colours are to be sharp."""
    made = mesh.to_open3d().to_legacy().subdivide_midpoint(1)
    return Mesh(
        np.asarray(made.vertices, np.float32), np.asarray(made.triangles, np.int32),
        np.asarray(made.vertex_normals, np.float32),
        np.rint(np.asarray(made.vertex_colors) * 255).astype(np.uint8),
    )  # fmt: skip


def measured(
    found: list[tuple[str, Mesh, float]], held_out: Chosen, pictures: Path | None
) -> Iterator[dict[str, Any]]:
    """Figures of each method, over all views held out."""
    errors: dict[str, dict[str, list[view_colors.ColorError]]] = {
        name: {"": [], "_bright": [], "_as_given": []} for name, _, _ in found
    }
    pixels = views = 0
    for number, keyframe in enumerate(held_out):
        assert keyframe.color is not None
        assert keyframe.intrinsics is not None
        look: Callable[[Mesh], view_colors.ShownView] = partial(
            view_colors.shown, T_world_camera=keyframe.T_world_camera, intrinsics=keyframe.intrinsics,
            shape=(keyframe.shape[0], keyframe.shape[1]),
        )  # fmt: skip
        shown = {name: look(mesh) for name, mesh, _ in found}
        where = np.logical_and.reduce(
            [view_colors.compared(mesh, keyframe, shown[name]) for name, mesh, _ in found]
        )
        if where.mean() < 0.05:
            continue
        views, pixels = views + 1, pixels + int(where.sum())
        rgb = keyframe.color[..., ::-1].astype(np.float32)
        row = [rgb]
        for name, view in shown.items():
            moved, lit = view_colors.registered(keyframe, view, where)
            bright = view_colors.as_bright(rgb, view, where)
            for kind, pair in (("", (moved, lit)), ("_bright", (rgb, bright)), ("_as_given", (rgb, view))):
                errors[name][kind].append(view_colors.color_error(*pair, where))
            row.append(bright.color)
        if pictures is not None:
            _write(pictures / f"view-{number:03}.png", np.hstack(row))
    for name, mesh, seconds in found:
        means = {kind: np.mean(each, axis=0).tolist() for kind, each in errors[name].items()}
        figures = {
            f"{what}{kind}": round(mean[k], 2 + 2 * k)
            for kind, mean in means.items() for k, what in enumerate(("psnr", "ssim"))
        }  # fmt: skip
        yield {"method": name, **figures, "views": views, "pixels": pixels, "triangles": len(mesh.faces),
               "cpu_s": round(seconds, 1)}  # fmt: skip


def _write(path: Path, rgb: NDArray[np.float32]) -> None:
    import cv2

    cv2.imwrite(str(path), rgb[..., ::-1].clip(0, 255).astype(np.uint8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("source", help="a dataset with depth, colour and poses")
    parser.add_argument("--voxel-size", type=float, default=0.02)
    parser.add_argument("--hold-out", type=int, default=5, metavar="N", help="every Nth frame (5)")
    parser.add_argument("--frames", type=int, default=10**9, help="at most, spread over the recording")
    parser.add_argument("--texture-size", type=int, default=4096)
    parser.add_argument("--texel", type=float, help="metres; default as the images have it")
    parser.add_argument("--choose", action="store_true", help="choose settings, judge them on other views")
    parser.add_argument("--ablation", action="store_true", help="also without alignment and even exposure")
    parser.add_argument("--open3d", action="store_true", help="beside Open3D")
    parser.add_argument("--open3d-rounds", type=int, default=100, help="of its colour map; 0 = without it")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="what each method shows, side by side")
    parser.add_argument("--out", type=Path, metavar="MESH", help="write the textured mesh, too")
    options = parser.parse_args()
    dataset = open_dataset(options.source)
    chosen = np.unique(np.linspace(0, len(dataset) - 1, min(options.frames, len(dataset)), dtype=np.intp))
    turn, judging = np.arange(len(chosen)) % options.hold_out, options.hold_out // 2
    sets = {"judge": turn == judging}
    if options.choose:
        sets = {"choose": turn == (judging + 2) % options.hold_out, **sets}
    keyframes = Chosen(dataset, chosen[~np.logical_or.reduce(list(sets.values()))])
    volume = Volume(options.voxel_size, sensor=dataset.sensor)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    found, then = [], time.process_time()
    for name, mesh in methods(volume, keyframes, options):
        found.append((name, mesh, time.process_time() - then))
        then = time.process_time()
    common = {"voxel_size": options.voxel_size, "source": options.source}
    psnr: dict[str, dict[str, float]] = {}
    for name, out in sets.items():
        pictures = options.pictures if name == "judge" else None
        for line in measured(found, Chosen(dataset, chosen[out]), pictures):
            print(json.dumps({"held_out": name, **line, **common}), flush=True)
            psnr.setdefault(name, {})[line["method"]] = line["psnr"]
    if options.choose:
        textures = [name for name in psnr["choose"] if name.startswith("texture")]
        best = max(textures, key=psnr["choose"].__getitem__)
        own, usual, voxel = (psnr["judge"][name] for name in (best, "texture", "voxel colour"))
        gains = {"gain_db": round(own - voxel, 2), "gain_of_default_db": round(usual - voxel, 2)}
        print(json.dumps({"chosen": best, **gains, **common}))
    print(json.dumps(surroundings(volume.config.threads or 0)))


if __name__ == "__main__":
    main()
