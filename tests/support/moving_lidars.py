# SPDX-License-Identifier: MIT
"""A LiDAR that goes and turns in a room while it measures, by formula: points, their times, and the truth."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion.geometry import se3

T0_NS, PERIOD_S = 1_700_000_000_000_000_000, 0.1
ROOM = np.array([[-9.0, -7.0, -1.5], [9.0, 7.0, 3.0]])


class Sweep(NamedTuple):
    """Points at their own times, where they belong at the sweep's begin, and seconds after that."""

    points: NDArray[np.float32]
    put_right: NDArray[np.float32]
    times_s: NDArray[np.float64]


def pose_at(t: float) -> NDArray[np.float64]:
    """T_world_lidar: on a curve at 4 m/s, turning to and fro."""
    yaw = 0.6 * np.sin(2 * t)
    R = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    return se3.transform(R, [5 * np.sin(0.8 * t), 2 * np.sin(0.7 * t) - 3, 0])


def pose_at_ns(stamp_ns: int) -> NDArray[np.float64]:
    return pose_at((stamp_ns - T0_NS) / 1e9)


def sweep(number: int, columns: int = 120, rings: int = 12) -> Sweep:
    """The turn that begins `number` periods after T0."""
    begin, tilt = number * PERIOD_S, np.radians(np.linspace(-15, 15, rings))
    points, right, times = [], [], []
    T_begin_world = se3.inverse(pose_at(begin))
    for angle, t in zip(np.linspace(0, 2 * np.pi, columns), np.linspace(0, PERIOD_S, columns), strict=True):
        rays = np.stack([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)], 1)
        T = pose_at(begin + t)
        away = rays @ T[:3, :3].T + 1e-12
        walls = (np.where(away > 0, ROOM[1], ROOM[0]) - T[:3, 3]) / away
        points.append(rays * walls.min(axis=1)[:, None])
        right.append(se3.apply(T_begin_world @ T, points[-1]))
        times += [t] * rings
    return Sweep(np.vstack(points).astype(np.float32), np.vstack(right).astype(np.float32), np.array(times))


def trajectory(first: int, stop: int, every_s: float = 0.01) -> tuple[list[int], list[NDArray[np.float64]]]:
    """Times in nanoseconds and poses, `every_s` from `first` to `stop` periods."""
    count = round((stop - first) * PERIOD_S / every_s) + 1
    seconds = [first * PERIOD_S + k * every_s for k in range(count)]
    return [T0_NS + round(t * 1e9) for t in seconds], [pose_at(t) for t in seconds]


def save(path: Path, points: NDArray[np.float32], field: str, moments: NDArray[Any]) -> None:
    """Write a PCD, PLY or LAS file with a time for each point, in a field of that name."""
    if path.suffix == ".las":
        laspy = pytest.importorskip("laspy")
        made = laspy.LasData(laspy.LasHeader(point_format=1, version="1.2"))
        made.header.scales = [1e-5] * 3
        made.x, made.y, made.z = points.T.astype(np.float64)
        made.gps_time = moments
        made.write(path)
        return
    kind = moments.dtype
    table = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (field, kind.newbyteorder("<"))])
    table["x"], table["y"], table["z"] = points.T
    table[field] = moments
    if path.suffix == ".ply":
        names = {"f4": "float", "f8": "double", "u4": "uint"}
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n" + "".join(
            f"property {names[table.dtype[name].str[1:]]} {name}\n" for name in table.dtype.names or ()
        )
        path.write_bytes(f"{head}end_header\n".encode() + table.tobytes())
    else:
        letter = {"f": "F", "u": "U"}[kind.kind]
        head = (
            f"VERSION 0.7\nFIELDS x y z {field}\nSIZE 4 4 4 {kind.itemsize}\nTYPE F F F {letter}\n"
            f"COUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
            f"POINTS {len(points)}\nDATA binary\n"
        )
        path.write_bytes(head.encode() + table.tobytes())


def off(found: Any, sweep: Sweep) -> float:
    """Metres of the worst point from where it belongs."""
    return float(np.abs(np.asarray(found) - sweep.put_right).max())
