# SPDX-License-Identifier: MIT
"""Events of a map for its viewers: new triangles, new poses, health, and the state of the link."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.wire.messages.health import Health


@dataclass(frozen=True, eq=False)
class Cleared:
    """Order to drop all that is shown: another map follows, or the same map from its start."""

    map: str
    voxel_size: float  # metres


@dataclass(frozen=True, eq=False)
class SurfaceUpdate:
    """The triangles of some cells. They replace all earlier triangles of these cells. A cell is a block.

    Attributes:
        cells: (n, 3) int32 block coordinates; an edge is 8 voxels.
        first_face: (n + 1,) int32: `first_face[i]` is the first face of cell i in the mesh, and
            `first_face[i+1]` is after its last. A cell without surface has no faces.
        mesh: triangles of these cells, in metres of the map.
        is_refined: (n,) bool: True for the surface that the map's settings ask for, False for the raw one.
        clients: sessions (16 bytes each) that saw these cells.
        client: (n,) int32: row in `clients` of the session that saw the cell last, or −1 if not known.
    """

    cells: NDArray[np.int32]
    first_face: NDArray[np.int32]
    mesh: Mesh
    is_refined: NDArray[np.bool_]
    clients: tuple[bytes, ...] = ()
    client: NDArray[np.int32] | None = None


@dataclass(frozen=True, eq=False)
class ScannerSeen:
    """A scanner sent a keyframe.

    Attributes:
        session: 16 bytes.
        seq: number of the keyframe in its session.
        T_world_camera: (4, 4) float64.
        intrinsics, shape: fx, fy, cx, cy and (height, width) in pixels; None without a camera (LiDAR).
        picture: JPEG as the scanner sent it; None without one, or if another picture came just before.
        client: name under which the scanner's key is allowed; empty without keys.
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
    """Poses at which all keyframes of the map are fused now.

    Attributes:
        paths: by session: (n,) int64 numbers and (n, 4, 4) float64 T_world_camera.
        held: how the sensors were held, from which the up direction is found; None if not known.
    """

    paths: dict[bytes, tuple[NDArray[np.int64], NDArray[np.float64]]]
    held: SensorPosture | None = None


@dataclass(frozen=True, eq=False)
class HealthSeen:
    """Health of the server. The event comes about once a second."""

    health: Health


@dataclass(frozen=True, eq=False)
class LinkSeen:
    """State of the link to the watched map. `problem` says why it is away; empty while it is there."""

    problem: str


MapEvent = Cleared | SurfaceUpdate | ScannerSeen | PathsFound | HealthSeen | LinkSeen
