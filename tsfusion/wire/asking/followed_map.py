# SPDX-License-Identifier: MIT
"""A map as its viewer follows it: what comes of it, how much of it the viewer holds, and the next questions.

No sockets. Each answer about cells is complete up to its version, so nothing can be missed, and no answer
overtakes another. Poses of keyframes come as scanners send them, and all of them again after some moved.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from tsfusion.core.errors import DecodeError
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.keyframe_rows import POSE, KeyframeRows
from tsfusion.geometry.map_questions import AnswerArrays
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.health import Health, MapHealth
from tsfusion.wire.messages.questions import (
    ANSWER_BYTES,
    LONGEST_WAIT_S,
    Cells,
    Keyframes,
    Scanned,
    Scans,
    ScansFound,
)

_PAUSE_S = 2.0  # wait between two rounds of questions: so long for each full answer of the last round


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


class FollowedMap:
    """The part of a map that its viewer holds, and the next question about the map.

    Attributes:
        epoch: name of the fuser's process; empty while nothing is known.
        voxel_size: metres; 0 while not known.
    """

    def __init__(self, name: str) -> None:
        self.name, self.epoch, self.voxel_size = name, "", 0.0
        self._until = 0  # version of the map up to which all changes came

    def forget(self) -> list[MapEvent]:
        """Drop all cells: the server has no such map."""
        was_known, self.voxel_size = self.voxel_size, 0.0
        self.epoch, self._until = "", 0
        return [Cleared(self.name, was_known)] if was_known else []

    def question(self, most_bytes: int = ANSWER_BYTES) -> Cells:
        """Return the next question."""
        return Cells(self._until, self.epoch, LONGEST_WAIT_S, most_bytes)

    def on_cells(self, epoch: str, arrays: AnswerArrays) -> list[MapEvent]:
        """Take the answer to the last question. Return the events that follow from it.

        Raises:
            DecodeError: for a malformed answer; ask again.
        """
        try:
            update, until = _update_of(arrays), int(arrays["until"])
            begins, voxel_size = bool(arrays["begins"]), float(arrays["voxel_size"])
        except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
            raise DecodeError(f"an answer about cells is malformed: {error!r}") from error
        if until < 0 or not 0 < voxel_size < math.inf:
            raise DecodeError(f"an answer about cells is up to {until}, of voxels of {voxel_size} m")
        if epoch != self.epoch and not begins:
            raise DecodeError("an answer about cells is of another process of the server")
        self.epoch, self._until, self.voxel_size = epoch, until, voxel_size
        events: list[MapEvent] = [Cleared(self.name, voxel_size)] if begins else []
        return [*events, update] if len(update.cells) else events


def _update_of(arrays: AnswerArrays) -> SurfaceUpdate:
    """Return the triangles of an answer. Raise DecodeError unless its arrays fit together."""
    mesh = Mesh(arrays["vertices"], arrays["faces"], arrays["normals"], arrays.get("colors"))
    cells, first_face, client = arrays["cells"], arrays["first_face"], arrays["client"]
    clients = tuple(one.tobytes() for one in arrays["sessions"])
    rows = len(cells)
    fits = cells.shape == (rows, 3) and first_face.shape == (rows + 1,)
    fits = fits and client.shape == arrays["is_refined"].shape == (rows,)
    fits = fits and bool((np.diff(first_face, prepend=0, append=len(mesh.faces)) >= 0).all())
    fits = fits and first_face[0] == 0 and first_face[-1] == len(mesh.faces)
    if not fits:
        raise DecodeError(f"what came for {rows} cells does not fit together")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise DecodeError("triangles have corners that did not come")
    if rows and not -1 <= client.min() <= client.max() < len(clients):
        raise DecodeError("cells were seen by sessions that did not come")
    return SurfaceUpdate(cells, first_face, mesh, arrays["is_refined"], clients, client)


class FollowedPaths:
    """The paths of a map's scanners, and the next questions about them."""

    def __init__(self) -> None:
        self._is_due = True
        self._next = 0.0  # time.monotonic()
        self._asked: Keyframes | None = None
        self._pages: list[KeyframeRows] = []  # of this round, or the last one
        self._epoch = ""
        self._moved: dict[bytes, NDArray[np.float64]] = {}  # T_map_odometry by session
        self._counts: tuple[int, ...] | None = None
        self._scans = ScansFound("", 0)  # the last answer about keyframes that came
        self._fused = self._fused_then = 0  # keyframes in the map: now, and when the last round began
        self._scanned = 0  # keyframes that scanners have sent since the last round began

    def question(self, now: float, most_bytes: int = ANSWER_BYTES) -> Keyframes | None:
        """Return the next question, for an answer of so many bytes, or None without one."""
        if self._asked is None and self._is_due and now >= self._next:
            full = sum(map(len, self._pages)) / questions.KEYFRAMES_AT_ONCE
            self._asked, self._is_due, self._next = Keyframes(), False, now + _PAUSE_S * max(full, 1)
            self._fused_then, self._scanned = self._fused, 0
            self._pages.clear()
        return self._asked and replace(self._asked, most_bytes=most_bytes)

    def on_keyframes(self, epoch: str, arrays: dict[str, NDArray[Any]]) -> list[MapEvent]:
        """Take the answer to the last question. Return the paths after the last answer of a round, else [].

        Raises:
            DecodeError: for a malformed answer; ask again.
        """
        asked = self._asked
        if asked is None:
            return []
        if asked.session and epoch != self._epoch:  # another process: earlier answers do not belong to it
            self._asked, self._is_due = None, True
            return []
        self._epoch = epoch
        try:
            page = self._page(arrays)
            last = arrays["last_session"].tobytes(), int(arrays["last"])
            held = SensorPosture(arrays["held"].tolist())
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise DecodeError(f"an answer about keyframes is malformed: {error!r}") from error
        self._pages.append(page)
        if last[0]:
            if last == (asked.session, asked.after):
                raise DecodeError("an answer about keyframes has no end")
            self._asked = Keyframes(session=last[0], after=last[1])
            return []
        self._asked = None
        rows = KeyframeRows.joined(self._pages)
        return [PathsFound({key: (each.seqs, each.matrices) for key, each in rows.by_session()}, held)]

    def _page(self, arrays: dict[str, NDArray[Any]]) -> KeyframeRows:
        sessions = tuple(one.tobytes() for one in arrays["sessions"])
        self._moved.update(zip(sessions, arrays["T_map_odometry"], strict=True))
        seqs, poses = arrays["seqs"].ravel(), arrays["poses"].reshape(-1, POSE)
        if not len(arrays["session"]) == len(seqs) == len(poses):
            raise ValueError("columns of different lengths")
        nowhere = np.zeros_like(seqs)
        return KeyframeRows.joined([KeyframeRows(sessions, arrays["session"], seqs, nowhere, nowhere, poses)])

    def scans_question(self, most_bytes: int) -> Scans:
        """Return the next question about keyframes that come."""
        return Scans(self._scans.until, self._scans.epoch, LONGEST_WAIT_S, most_bytes)

    def on_scans(self, found: ScansFound) -> list[MapEvent]:
        """Take the answer to the last question about keyframes that come."""
        self._is_due |= found.missed
        self._scans = found
        return [self._seen(one) for one in found.scans]

    def _seen(self, scanned: Scanned) -> ScannerSeen:
        self._scanned += not scanned.late
        T = np.array([*scanned.pose, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
        moved = self._moved.get(scanned.session)
        return ScannerSeen(
            session=scanned.session,
            seq=scanned.seq,
            T_world_camera=T if moved is None else moved @ T,
            intrinsics=scanned.intrinsics,
            shape=scanned.shape,
            picture=scanned.picture or None,
            client=scanned.client,
        )

    def on_health(self, health: MapHealth) -> None:
        """Take the map's health: it shows if keyframes moved, left, or came from the journal alone."""
        counts = (
            health.corrections,
            health.keyframes_moved,
            health.keyframes_forgotten,
            health.corrections_waiting,
            health.fuser_restarts,
        )
        before, self._counts = self._counts, counts
        self._fused = health.keyframes_fused
        came_alone = not health.waiting and self._fused - self._fused_then > self._scanned
        self._is_due |= came_alone or before not in (None, counts)
