# SPDX-License-Identifier: MIT
"""Examine the stated covariance of RGB-D poses: does it cover the errors against truth as often as it says?

    python lab/evaluation/examine_covariance.py              a line a scene
    python lab/evaluation/examine_covariance.py --only room  some scenes

The error is that of a frame's pose relative to the tracking keyframe that it was found from, as a twist of
six numbers. A line tells the share of frames whose error is inside the ellipsoid that should hold 50, 80, 90
and 95 %. `held out` multiplies the stated deviations by the factor that covers 90 % of the frames of the
other scenes, each with equal weight. `place` and `turn` are three of the six numbers alone, at 90 %.

The truth of some recordings has errors that are as large; its published deviations are added to the stated
ones (`TRUTH`). Recordings are found under TSFUSION_DATA.
"""

import argparse
import os
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.evaluation.examined_scenes import FRESH_ROOMS, SCENES
from lab.evaluation.recording_variants import VARIANTS, Frames, without_color
from tsfusion.core.errors import DatasetError
from tsfusion.geometry import se3
from tsfusion.scanner.localization.localizer import Lost
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer

PLAYED = ("beginning", "backwards, every 2nd", "there and back", "gamma steps", "holes in depth",
          "half the size")  # fmt: skip
DEPTH_ALONE = ", depth alone"
# Deviations of the truth: metres and radians for each axis of a relative pose. Motion capture: Sturm et al.
# 2012. Redwood's poses come from a reconstruction: its exact depth is off by 1 mm between frames.
TRUTH = {"freiburg1_xyz": (1e-3, np.radians(0.5)), "Redwood": (1e-3, 1e-3)}
NOMINAL = {0.5: 5.348, 0.8: 8.558, 0.9: 10.645, 0.95: 12.592}  # share: χ² of six degrees of freedom
THREE = 6.251  # χ² of three degrees of freedom at 90 %
FACTORS = np.geomspace(0.2, 8, 60)
PATIENCE = 20  # frames lost in a row

Case = tuple[NDArray[np.float64], NDArray[np.float64]]  # (6,) error and (6, 6) covariance, camera's axes


def cases(frames: Frames) -> list[Case]:
    """Track the frames; return error and stated covariance of each pose."""
    localizer, found, lost = RGBDLocalizer(), list[Case](), 0
    keyframes: dict[int, tuple[se3.Transform, se3.Transform]] = {}  # estimated and true T_world_camera
    newest = -1
    for frame in frames:
        pose, truth = localizer.track(frame), frame.T_world_camera
        if isinstance(pose, Lost) or truth is None:
            lost += 1
            if lost > PATIENCE:
                localizer.reset()
                lost, keyframes = 0, {}
            continue
        lost = 0
        before = newest if pose.starts_anchor else pose.anchor
        if pose.covariance is not None and before in keyframes:
            estimated, true = (
                se3.inverse(one) @ other
                for one, other in zip(keyframes[before], (pose.T_world_camera, truth), strict=True)
            )
            found.append((se3.log(se3.inverse(estimated) @ true), pose.covariance))
        if pose.starts_anchor:
            keyframes[pose.anchor], newest = (pose.T_world_camera, truth), pose.anchor
    return found


def coverage(some: Sequence[Case], factor: float, truth: tuple[float, float], chi2: float = NOMINAL[0.9],
             part: slice = slice(None)) -> float:  # fmt: skip
    """Return the share of errors inside an ellipsoid of the stated deviations times a factor."""
    own = np.diag([truth[0] ** 2] * 3 + [truth[1] ** 2] * 3)
    inside = [
        error[part] @ np.linalg.solve((factor**2 * stated + own)[part, part], error[part]) <= chi2
        for error, stated in some
    ]
    return float(np.mean(inside))


def scenes(only: Sequence[str]) -> dict[str, list[Case]]:
    """Play all scenes; return the cases of each."""
    found: dict[str, list[Case]] = {}
    for name in [name for name in [*SCENES, *FRESH_ROOMS] if any(word in name for word in only)]:
        try:
            frames = {**SCENES, **FRESH_ROOMS}[name]()
        except (DatasetError, OSError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        for variant in PLAYED:
            rng = np.random.default_rng(zlib.crc32(f"{name}/{variant}".encode()))
            played = VARIANTS[variant](frames, rng)
            found.setdefault(name, []).extend(cases(played))
            if variant == PLAYED[0]:
                found.setdefault(name + DEPTH_ALONE, []).extend(cases(without_color(played)))
    return {name: some for name, some in found.items() if len(some) >= PATIENCE}


def report(found: dict[str, list[Case]]) -> str:
    """Return the table of all scenes."""
    lines = [
        f"{'share of errors covered, %':<36}{'frames':>7}{'50':>6}{'80':>5}{'90':>5}{'95':>5}{'place':>7}"
        f"{'turn':>6}{'held out':>10}{'factor':>8}{'mm':>7}{'mrad':>6}"
    ]
    scene = {name: name.removesuffix(DEPTH_ALONE) for name in found}
    known = {name: TRUTH.get(scene[name], (0.0, 0.0)) for name in found}
    curves = {
        name: np.array([coverage(some, f, known[name]) for f in FACTORS]) for name, some in found.items()
    }
    for name, some in found.items():
        others = [curve for other, curve in curves.items() if scene[other] != scene[name]]
        held = int(np.argmax(np.mean(others, axis=0) >= 0.9)) if others else 0
        figures = [coverage(some, 1, known[name], chi2) for chi2 in NOMINAL.values()]
        parts = [coverage(some, 1, known[name], THREE, part) for part in (slice(0, 3), slice(3, 6))]
        stated = np.median([np.sqrt(np.diag(C)[[0, 3]]) for _, C in some], axis=0)
        shares = "".join(f"{100 * share:>5.0f}" for share in figures)
        lines.append(
            f"{name:<36}{len(some):>7} {shares}{100 * parts[0]:>7.0f}{100 * parts[1]:>6.0f}"
            f"{100 * curves[name][held]:>10.0f}{FACTORS[held]:>8.2f}"
            f"{1e3 * stated[0]:>7.2f}{1e3 * stated[1]:>6.2f}"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", metavar="WORDS", help="scenes whose name has one: a,b")
    print(report(scenes(parser.parse_args().only.split(","))))
    return 0


if __name__ == "__main__":
    import cv2

    cv2.setNumThreads(1)
    sys.exit(main())
