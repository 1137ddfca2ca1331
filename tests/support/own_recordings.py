# SPDX-License-Identifier: MIT
"""What people bring along: real frames of 7-Scenes in folders of their own, without a camera's file."""

from pathlib import Path

import cv2
import numpy as np

from tsfusion.datasets.trajectory_files import read_matrix, write_tum

_EVERY = 10
KINECT = "585 0 320\n0 585 240\n0 0 1\n"


def stems(data: Path, count: int) -> list[Path]:
    """Frames of the kitchen, a third of a second apart: files without their ending."""
    depth = sorted((data / "seq-01").glob("*.depth.png"))[: count * _EVERY : _EVERY]
    return [path.with_name(path.name[: -len(".depth.png")]) for path in depth]


def redwood_like(root: Path, kitchen: Path, count: int = 3) -> Path:
    """`depth/`, `color/` and `trajectory.log`, as Open3D's reconstruction system takes them."""
    lines = []
    for number, stem in enumerate(stems(kitchen, count)):
        _copy(Path(f"{stem}.depth.png"), root / "depth" / f"{number:05d}.png")
        _copy(Path(f"{stem}.color.jpg"), root / "color" / f"{number:05d}.jpg")
        lines.append(f"{number} {number} {number + 1}\n{Path(f'{stem}.pose.txt').read_text().strip()}\n")
    (root / "trajectory.log").write_text("".join(lines))
    return root


def tum_like(root: Path, kitchen: Path, count: int = 3) -> Path:
    """`depth.txt`, `rgb.txt` and `groundtruth.txt` of somebody's own recorder, depth in 0.2 mm."""
    stamps, poses, lists = [], [], {"depth": "", "rgb": ""}
    for number, stem in enumerate(stems(kitchen, count)):
        stamp = 10**9 * (100 + number) // 10
        seconds = f"{stamp / 1e9:.6f}"
        depth = cv2.imread(f"{stem}.depth.png", cv2.IMREAD_UNCHANGED)
        (root / "depth").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "depth" / f"{seconds}.png"), (depth * 5).astype(np.uint16))
        _copy(Path(f"{stem}.color.jpg"), root / "rgb" / f"{seconds}.jpg")
        lists["depth"] += f"{seconds} depth/{seconds}.png\n"
        lists["rgb"] += f"{seconds} rgb/{seconds}.jpg\n"
        stamps.append(stamp)
        poses.append(read_matrix(Path(f"{stem}.pose.txt")))
    for name, text in lists.items():
        (root / f"{name}.txt").write_text(text)
    write_tum(root / "groundtruth.txt", stamps, poses)
    return root


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(source.read_bytes())
