# SPDX-License-Identifier: MIT
"""Events of a map, as its viewers hear of them: new triangles, where a scanner is, poses moved."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import HeldSensor
from tsfusion.wire.messages.health import Health


@dataclass(frozen=True, eq=False)
class Cleared:
    """All that was shown is void: another map, or the same one from its beginning."""

    map: str
    voxel_size: float  # metres


@dataclass(frozen=True, eq=False)
class SurfaceUpdate:
    """The triangles of some cells, instead of all earlier ones there. A cell is a block of 8³ voxels.

    Attributes:
        cells: (n, 3) int32, block coordinates; an edge is 8 voxels.
        first_face: (n + 1,) int32: the cell in row i has the faces from `first_face[i]` to
            `first_face[i + 1]` of the mesh; none, where the surface has gone.
        mesh: of these cells, in metres of the map.
        is_refined: whether it is the surface that the map's settings ask for, or the raw one.
        clients: sessions (16 bytes each) that saw these cells.
        client: (n,) int32, the row in `clients` of who saw the cell last; −1 = not known.
    """

    cells: NDArray[np.int32]
    first_face: NDArray[np.int32]
    mesh: Mesh
    is_refined: bool
    clients: tuple[bytes, ...] = ()
    client: NDArray[np.int32] | None = None


@dataclass(frozen=True, eq=False)
class ScannerSeen:
    """A scanner sent a keyframe.

    Attributes:
        session: 16 bytes.
        seq: the keyframe's number in its session.
        T_world_camera: (4, 4) float64.
        intrinsics, shape: fx, fy, cx, cy and (height, width) in pixels; None = it has no camera (a LiDAR).
        picture: JPEG, as the scanner sent it; None = there is none, or another one came just before.
        client: name that its key is allowed under; empty without keys.
    """

    session: bytes
    seq: int
    T_world_camera: NDArray[np.float64]
    intrinsics: Intrinsics | None = None
    shape: tuple[int, int] | None = None
    picture: bytes | None = None
    client: str = ""


@dataclass(frozen=True, eq=False)
class PathsFound:
    """Poses of all of the map's keyframes, those that they are fused with now.

    Attributes:
        paths: by session: (n,) int64 numbers and (n, 4, 4) float64 T_world_camera.
        held: how the sensors were held, by which up is found; None = nobody knows.
    """

    paths: dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]]
    held: HeldSensor | None = None


@dataclass(frozen=True, eq=False)
class HealthSeen:
    """The health of the server, about once a second."""

    health: Health


@dataclass(frozen=True, eq=False)
class LinkSeen:
    """Presence of what is watched: `problem` says why it is away, in words; empty = it is there."""

    problem: str


MapEvent = Cleared | SurfaceUpdate | ScannerSeen | PathsFound | HealthSeen | LinkSeen
