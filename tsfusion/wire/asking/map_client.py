# SPDX-License-Identifier: MIT
"""Client that asks the map of a running server, without Taichi: how far is it to the wall?"""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from tsfusion.core.config import DEFAULT_MAP, Surface
from tsfusion.core.errors import AnswerLate, DecodeError, InvalidConfig, ServerUnreachable, TransportError
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import Samples, View, checked_points
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice
from tsfusion.geometry.map_questions import LONGEST_S, AnswerArrays, Field, Raycast, Sample, Slice, crc_of
from tsfusion.geometry.up_direction import Up
from tsfusion.wire.asking.queries import Exchange
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Answer, MapVersion, Question
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys, client_keys

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from tsfusion.geometry.map_questions import DistanceFieldSettings, SliceSettings, ViewSettings

Result = TypeVar("Result")


class Answered(Struct, Generic[Result], frozen=True, kw_only=True, eq=False):
    """Answer of a map, the state of the map that it belongs to, and the time it took.

    Attributes:
        result: the type that the method of `Volume` with the same name returns.
        state: state of the map; the whole result belongs to this one state.
        delay_s: seconds from question to answer, measured by the client.
        waited_s: the part of `delay_s` in which the question waited in the server for the map.
        took_s: the part of `delay_s` in which the server computed the answer.
    """

    result: Result
    state: MapVersion
    delay_s: float
    waited_s: float = 0.0
    took_s: float = 0.0


class MapClient:
    """A map on a server, asked by the methods of `Volume`: each returns its result in an `Answered`.

    The map answers between two keyframes, within milliseconds. After the map has moved, the client asks its
    new server (without keys, only on this machine). A question without an answer in time raises. The default
    surface is the raw one: smoothing takes the server longer. Use the client from one thread.

    Args:
        address: address of the server: tcp://HOST:PORT.
        map_: name of the map on the server.
        control: control address of the server; None takes the port after that of `address`.
        timeout: seconds that a question may take; each method can take another value.
        key: path of the client's secret key, for a server with keys.
        server_key: the server's public key: its path, or the 40 characters.
        keys: result of `curve.client_keys`, in place of `key` and `server_key`.
        compress: compress large answers, for a slow link; None does so unless the server is on this machine.

    Raises:
        InvalidConfig: for a malformed address, or for keys that cannot be used.

    Examples:
        >>> with tsfusion.MapClient("tcp://127.0.0.1:5555", timeout=5.0) as live:
        ...     found = live.sample(np.zeros((4, 3)))
        >>> found.result.distance.shape, found.state.keyframes > 0
        ((4,), True)
    """

    def __init__(
        self,
        address: str,
        map_: str = DEFAULT_MAP,
        *,
        control: str | None = None,
        timeout: float = 1.0,
        key: str | None = None,
        server_key: str | None = None,
        keys: ClientKeys | None = None,
        compress: bool | None = None,
    ) -> None:
        self.map, self.timeout = map_, timeout
        host, _ = sockets.parse_address(address)
        self._compress = not sockets.is_loopback(host) if compress is None else compress
        keys = client_keys(key, server_key) if keys is None else keys
        self._server = Exchange(address, control, keys)
        self._number = 0

    @property
    def address(self) -> str:
        """Address of the server that has the map now."""
        return self._server.address

    def close(self) -> None:
        """Close the connection."""
        self._server.close()

    def __enter__(self) -> "MapClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def sample(
        self,
        points: ArrayLike,
        *,
        min_weight: float | None = None,
        surface: Surface | None = "raw",
        timeout: float | None = None,
    ) -> Answered[Samples]:
        """Return the signed distance, its weight and its gradient at points; see `Volume.sample`.

        Args:
            points: (n, 3) metres, at most `map_questions.MOST_POINTS`: an answer is of one state of the map.
            min_weight, surface: as for `Volume.extract_mesh`; None takes the map's settings.
            timeout: seconds; None takes the client's.

        Raises:
            InvalidConfig: for an array without points, of another shape, or with too many points.
            AnswerLate: when the map did not answer in time.
            ServerUnreachable: when no server answers.
            TransportError: when the server cannot answer, with the reason.
        """
        rows = checked_points(points).astype(np.float32)
        if not len(rows):
            raise InvalidConfig("there is no point to ask about")
        frames = questions.point_frames(rows)
        question = Sample(len(rows), crc_of(frames), min_weight, surface)
        answer, arrays, delay = self._ask(question, frames, timeout)
        return _answered(question.result(arrays, answer.reach), answer, delay)

    def raycast(
        self,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        *,
        max_age: float = 0.0,
        timeout: float | None = None,
        **how: "Unpack[ViewSettings]",
    ) -> Answered[View]:
        """Return the view of the surface by a pinhole camera; see `Volume.raycast`. Raises as `sample`.

        Args:
            intrinsics, T_world_camera, shape: as for `Volume.raycast`.
            max_age: seconds by which the shown state may be older than the newest one. 0 shows the newest
                state, and recent changes are meshed first. With 0.2 the server meshes ahead for cameras that
                look where the last one looked. `state` says which state was shown.
            timeout: seconds; None takes the client's.
            how: as for `Volume.raycast`, but the surface is `"raw"` by default. Depth alone is a fifth of the
                bytes.
        """
        how.setdefault("surface", "raw")
        question = Raycast.of(intrinsics, T_world_camera, shape, max_age, **how)
        answer, arrays, delay = self._ask(question, [], timeout)
        return _answered(question.result(arrays), answer, delay)

    def occupancy_slice(
        self, low: float, high: float, *, up: Up | str, timeout: float | None = None,
        **how: "Unpack[SliceSettings]",
    ) -> Answered[OccupancySlice]:  # fmt: skip
        """Return the costmap of obstacles between two heights; see `Volume.occupancy_slice`.

        Args:
            low, high, up, timeout, how: as for `distance_slice`, without `max_distance`.
        """
        question = Slice.of("occupancy", low, high, up, **how)
        answer, arrays, delay = self._ask(question, [], timeout)
        return _answered(question.occupancy(arrays), answer, delay)

    def distance_slice(
        self, low: float, high: float, *, up: Up | str, unseen_is_free: bool = False,
        timeout: float | None = None, **how: "Unpack[SliceSettings]",
    ) -> Answered[DistanceSlice]:  # fmt: skip
        """Return horizontal distances to obstacles between two heights; see `Volume.distance_slice`.

        The server keeps the slices of a `box` that were asked last, and updates them. The first answer
        therefore takes longest. Raises as `sample`.

        Args:
            low, high: metres along `up`, such as "z".
            unseen_is_free: as for `Volume.distance_slice`.
            timeout: seconds; None takes the client's.
            how: `box`, `resolution`, `max_distance`, `min_weight`: as for `Volume.distance_slice`.
        """
        question = Slice.of("distance", low, high, up, **how)
        answer, arrays, delay = self._ask(question, [], timeout)
        return _answered(question.distances(arrays, unseen_is_free=unseen_is_free), answer, delay)

    def distance_field(
        self,
        box: Sequence[float],
        *,
        unseen_is_free: bool = False,
        timeout: float | None = None,
        **how: "Unpack[DistanceFieldSettings]",
    ) -> Answered[DistanceField]:
        """Return the distance of each voxel in a box to the nearest surface; see `Volume.distance_field`.

        Raises as `sample`.

        Args:
            box: x0 y0 z0 x1 y1 z1, metres in the map's frame.
            unseen_is_free: as for `Volume.distance_field`.
            timeout: seconds; None takes the client's.
            how: `max_distance`: metres (0.5), the cost grows with its cube; `subvoxel`, `min_weight`: as for
                `Volume.distance_field`.
        """
        question = Field.of(box, **how)
        answer, arrays, delay = self._ask(question, [], timeout)
        return _answered(question.result(arrays, unseen_is_free=unseen_is_free), answer, delay)

    def _ask(
        self, question: Question, frames: Sequence[Any], timeout: float | None
    ) -> tuple[Answer, AnswerArrays, float]:
        """Ask a question. Return the answer, its arrays, and the seconds it took."""
        seconds = self.timeout if timeout is None else timeout
        if not 0 < seconds <= LONGEST_S:
            raise InvalidConfig(f"timeout must be > 0 and up to {LONGEST_S:g} s, got {seconds:g}")
        if problem := question.problem([memoryview(frame) for frame in frames]):
            raise InvalidConfig(problem)
        began, self._number = time.monotonic(), self._number + 1
        command = Command(
            name="ask",
            map=self.map,
            question=question,
            number=self._number,
            timeout_s=seconds,
            compress=self._compress,
        )
        try:
            reply, arrays = self._server.ask(command, frames, timeout=seconds)
        except ServerUnreachable as error:
            if not self._server.is_there:
                raise
            raise AnswerLate(
                f"the map {self.map} at {self.address} did not answer within {seconds:g} s: "
                "ask again, or give it longer (timeout)"
            ) from error
        delay = time.monotonic() - began
        if reply.answer is None:
            raise TransportError(f"the server at {self.address} sent a reply without an answer")
        try:
            return reply.answer, questions.unpack(reply.answer, arrays), delay
        except DecodeError as error:
            raise TransportError(f"the server at {self.address}: {error}") from error


def _answered(result: Result, answer: Answer, delay_s: float) -> Answered[Result]:
    return Answered(
        result=result,
        state=answer.state,
        delay_s=delay_s,
        waited_s=answer.waited_s,
        took_s=answer.took_s,
    )
