# SPDX-License-Identifier: MIT
"""Send keyframes to a server, in five lines for a program with its own localiser.

    with tsfusion.Client("tcp://127.0.0.1:5555", spool="spool-dir") as client:
        for keyframe in keyframes:
            client.send(keyframe)
        client.flush(timeout=10.0)

`send` encodes a keyframe and writes it to the spool; a thread of its own sends what is there. The policy
decides what happens when keyframes come faster than the map takes them (`tsfusion.delivery.backpressure`).
Taichi is never imported.
"""

import atexit
import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import ClientConfig, Policy, override
from tsfusion.core.errors import (
    FlushTimeout,
    InvalidConfig,
    KeyframeRefused,
    NotAllowed,
    ServerUnreachable,
    TransportError,
    WorldRefused,
)
from tsfusion.delivery.backpressure import Backpressure
from tsfusion.delivery.outbox import LinkState, Outbox
from tsfusion.delivery.outcomes import ClientStats
from tsfusion.delivery.sender import Sender
from tsfusion.delivery.spool import Spool
from tsfusion.geometry.keyframe import Keyframe, keyframe_of
from tsfusion.geometry.sample_ranges import wrong_unit
from tsfusion.geometry.sweeps import skewed
from tsfusion.wire.messages.messages import KeyframeTimes
from tsfusion.wire.records import corrections
from tsfusion.wire.records.record_header import WORLD_NAME
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import client_keys
from tsfusion.wire.sockets.sockets import control_address

__all__ = ["Client", "ClientStats"]

_SEGMENTS = 8  # a full spool has at least so many files: it shrinks by whole files
_SILENCE = 1.0  # seconds; the server answers a ping every half second

log = logging.getLogger(__name__)


class Client:
    """Sends keyframes to a server, and keeps each keyframe until it is on the server's disk.

    Args:
        address: the server's data address.
        spool: folder for keyframes that are not acknowledged yet. Records of a dead client in it are sent
            first. None makes a temporary folder, deleted by `close`. A `Spool` brings its own map and world.
        control: the server's control address; default the port after `address`.
        world: name of the coordinate frame of the poses, up to 64 letters, digits, - and _ (such as
            `uuid.uuid4().hex`), for a client that localises itself: a map takes keyframes of one world. Empty
            is for poses from outside; their source ensures that all poses of a map share one frame. None
            takes the world of the records in the spool.
        same_frame: declares that the poses are in the frame of the map, whatever worlds the map has.
        map: the map to scan into; default the config's, as for `policy`, `key` and `server_key`.
        policy: treatment of keyframes that come faster than the map takes them.
        key: the file of this client's secret key.
        server_key: the server's public key, or its file.
        config: the other settings; its addresses are not used.

    Raises:
        InvalidConfig: for a malformed address or setting, or a key file that cannot be used.
        JournalError: when the spool cannot be used, another client uses it, or its records are for
            another map or of another world.
        TransportError: when no socket can be opened.

    Examples:
        >>> with tsfusion.Client("tcp://127.0.0.1:5555") as client:
        ...     number = client.send(
        ...         tsfusion.Keyframe(
        ...             depth=np.full((480, 640), 1500, np.uint16),  # millimetres
        ...             intrinsics=tsfusion.Intrinsics(525.0, 525.0, 319.5, 239.5),
        ...             T_world_camera=np.eye(4),
        ...         )
        ...     )
        ...     client.flush(timeout=10.0)  # on the server's disk, or an error
        >>> number
        1
    """

    def __init__(
        self,
        address: str = "tcp://127.0.0.1:5555",
        *,
        spool: str | os.PathLike[str] | Spool | None = None,
        control: str | None = None,
        world: str | None = None,
        same_frame: bool = False,
        map: str | None = None,
        policy: Policy | None = None,
        key: str | os.PathLike[str] | None = None,
        server_key: str | os.PathLike[str] | None = None,
        config: ClientConfig | None = None,
    ) -> None:
        keys = {
            name: os.fspath(given)
            for name, given in (("key", key), ("server_key", server_key))
            if given is not None
        }
        if isinstance(spool, Spool):
            map = spool.map_name
        self._config = override(config or ClientConfig(), map=map, policy=policy, **keys)
        connection_keys = client_keys(self._config.key, self._config.server_key)
        self._address = address = sockets.connect_address(address)
        self._control = sockets.connect_address(control_address(address, control))
        if world and not re.fullmatch(WORLD_NAME, world):
            raise InvalidConfig(f"world must be 1 to 64 letters, digits, - and _, got {world!r}")
        if not isinstance(spool, Spool):
            segment_bytes = min(self._config.segment_bytes, self._config.spool_bytes // _SEGMENTS)
            spool = Spool(spool, segment_bytes, map_name=self._config.map, world=world, same_frame=same_frame)
        self._own_outbox, self._pid = Outbox(spool), os.getpid()
        self.logs_refusal = True  # log if the world is refused; False for a run that calls `check_world`
        self._pressure = Backpressure(self._outbox, self._config)
        try:
            self._sender = Sender(address, self._control, self._outbox, self._config, connection_keys)
        except OSError as error:
            self._outbox.close()  # another client can have the spool
            raise TransportError(f"cannot open a socket: {error.strerror}") from error
        self._sending = threading.Lock()
        self._closed = self._began_sending = False
        self.skewed = 0  # number of keyframes sent with point times, but without motion
        self._began = time.monotonic()
        self._thread = threading.Thread(target=self._sender.run, name="tsfusion-client", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # no temporary spool stays behind when nobody calls `close`

    @property
    def _outbox(self) -> Outbox:
        """The outbox, for the process that made the client; a forked process lacks the sending thread."""
        if os.getpid() != self._pid:
            raise TransportError("the client belongs to the process that forked this one: make another")
        return self._own_outbox

    def send(self, keyframe: Keyframe) -> int | None:
        """Put a keyframe into the spool. Return its number, or None if it is skipped (`stats.skipped`).

        The call never waits for the network, unless the policy is `block`. It never fails because of the
        disk. If the map has keyframes of another world, that is logged, and the keyframe waits in the spool.

        Args:
            keyframe: also a dict of a keyframe's fields, or an object with such attributes.

        Raises:
            TransportError: after `close`, also when that happens while this waits.
        """
        keyframe = keyframe_of(keyframe)
        if not self._began_sending:
            self._began_sending = True
            if wrong := wrong_unit(keyframe):
                log.warning("the first keyframe has %s", wrong)
        if keyframe.point_times_s is not None:
            self.skewed += 1
            if self.skewed == 1:
                log.warning(skewed("points have times, and no motion is known"))
        while True:
            self._outbox.wait(lambda: not self._pressure.must_wait, None, self._check_running)
            with self._sending:
                self._check_running()
                if self._pressure.must_wait:  # another thread took the turn
                    continue
                seq = self._pressure.put(keyframe)
            if seq is not None:
                self._sender.wake()
            if self.logs_refusal and self.is_of_other_world:
                self.logs_refusal = False
                log.error("nothing is sent: %s", self.link_state.why)
            return seq

    def correct(
        self,
        poses: Mapping[int, NDArray[np.float64]],
        *,
        T_map_odometry: NDArray[np.float64] | None = None,
        removed: Iterable[int] = (),
    ) -> int | None:
        """Correct the poses of keyframes that were sent before. Return the correction's number, or None.

        A correction is a record like a keyframe, with the session's next number. It waits in the spool until
        it is on the server's disk (`stats.corrections_acknowledged`). The number is None if the spool cannot
        keep it (`stats.corrections_refused`). The newest pose of a keyframe counts; keyframes that are not
        named keep theirs. The call never waits, whatever the policy.

        Args:
            poses: by the number that `send` returned, (4, 4) float64 `T_world_camera`.
            T_map_odometry: (4, 4) float64, transform to multiply from the left to poses after the last
                keyframe; None keeps the present one.
            removed: numbers of keyframes to take out of the map.

        Raises:
            InvalidKeyframe: for a number that was never sent, a pose that is no rigid transform, or more than
                100,000 keyframes.
            TransportError: after `close`.
        """
        correction = corrections.checked(poses, T_map_odometry=T_map_odometry, removed=removed)
        outbox = self._outbox
        with self._sending:
            self._check_running()
            outbox.check_known(correction.seqs)
            outbox.check_known(correction.removed)
            seq = self._pressure.put_correction(correction)
        if seq is not None:
            self._sender.wake()
        return seq

    def connect(self, timeout: float | None = None) -> None:
        """Wait until the server has answered. Not needed before `send`.

        Args:
            timeout: seconds; None takes `connect_timeout` of the client's settings.

        Raises:
            NotAllowed: as soon as the server refuses the keys, or the lack of keys.
            WorldRefused: as soon as the server says that the map has keyframes of another world.
            ServerUnreachable: when the server has not answered within `timeout` seconds, or refuses this
                client.
        """
        timeout = self._config.connect_timeout if timeout is None else timeout
        box = self._outbox
        self._wait(lambda: box.link_state.is_connected or box.link_state.is_refused, timeout)
        self.check_world()
        state = box.link_state
        if state.is_refused:
            raise (NotAllowed if state.kind == "locked_out" else ServerUnreachable)(state.why)
        if not state.is_connected:
            raise ServerUnreachable(
                f"{self._why()} (waited {timeout:g} s); is `tsfusion serve` running there, and is the port "
                "right?"
            )

    def wait_answer(self, timeout: float) -> None:
        """Wait until the server has answered or is known to be absent.

        Args:
            timeout: seconds; after it, the call returns without an error.
        """

        def is_known() -> bool:
            return (
                self.link_state.kind != "connecting" or self._sender.finds_nobody or bool(self.link_state.why)
            )

        self._wait(is_known, timeout)

    @property
    def spool_folder(self) -> Path:
        """Folder of the spool."""
        return self._outbox.spool.folder

    @property
    def link_state(self) -> LinkState:
        """State of the link to the server."""
        return self._outbox.link_state

    @property
    def world(self) -> str:
        """Name of the coordinate frame of the poses; empty for poses from outside."""
        return self._outbox.spool.world

    @property
    def is_of_other_world(self) -> bool:
        """True if the server said that the map has keyframes of another world. Nothing is sent then."""
        return self.link_state.kind == "other_world"

    def check_world(self) -> None:
        """Raise WorldRefused if the server said that the map has keyframes of another world."""
        if self.is_of_other_world:
            raise WorldRefused(self.link_state.why)

    def flush(self, timeout: float = 10.0) -> None:
        """Wait until everything sent is on the server's disk, corrections included.

        Args:
            timeout: seconds.

        Raises:
            WorldRefused: as soon as the map turns out to have keyframes of another world.
            FlushTimeout: after `timeout` seconds. The rest stays in the spool, and the client goes on sending
                it.
            KeyframeRefused: when the server refused some records for good since the last flush, or the spool
                had no room for them.
        """
        done = self._wait(lambda: self._outbox.is_durable or self.is_of_other_world, timeout)
        if not self._outbox.is_durable:
            self.check_world()
        if refusals := self._outbox.take_refusals():
            raise KeyframeRefused(refusals)
        if not done:
            waiting = self._outbox.describe_waiting()
            kept = "" if self._outbox.spool.temporary else f"; they stay in {self._outbox.spool.folder}"
            raise FlushTimeout(f"{waiting} not acknowledged after {timeout:g} s: {self._why()}{kept}")

    def wait_fused(self, timeout: float = 60.0) -> None:
        """Wait until the map has taken or rejected every record sent (`stats.rejected` counts rejections).

        Args:
            timeout: seconds.

        Raises:
            FlushTimeout: after `timeout` seconds.
        """
        if not self._wait(lambda: self._outbox.is_fused, timeout):
            raise FlushTimeout(f"the map does not have every keyframe after {timeout:g} s: {self._why()}")

    def wait_settled(self, timeout: float = 60.0) -> None:
        """Wait until the map has everything sent, and each keyframe at its newest pose (`correct`).

        The map then equals, to the bit, a fresh map of the keyframes at these poses. The wait includes
        corrections of other clients.

        Args:
            timeout: seconds.

        Raises:
            FlushTimeout: after `timeout` seconds; the server goes on.
        """
        if not self._wait(lambda: self._outbox.is_settled, timeout):
            left = self._outbox.stats().corrections_waiting
            moves = f"{left} keyframes are to be moved" if left else self._why()
            raise FlushTimeout(f"the map is not settled after {timeout:g} s: {moves}")

    @property
    def is_settled(self) -> bool:
        """True if the map has everything sent, and each keyframe at its newest pose (`wait_settled`)."""
        return self._outbox.is_settled

    def wait_meshed(self, timeout: float = 60.0) -> None:
        """Wait until everything sent is in the server's mesh, or in the next mesh that a client asks for.

        Args:
            timeout: seconds.

        Raises:
            FlushTimeout: after `timeout` seconds.
        """
        if not self._wait(lambda: self._outbox.is_meshed, timeout):
            raise FlushTimeout(f"the mesh is not up to date after {timeout:g} s: {self._why()}")

    @property
    def records(self) -> list[KeyframeTimes]:
        """Stamps of all stages of the last 65536 keyframes, on this process's monotonic clock."""
        return self._outbox.times()

    @property
    def newest_fused(self) -> KeyframeTimes | None:
        """The stamps of the newest keyframe in the map, or None without one."""
        return self._outbox.newest_fused()

    @property
    def stats(self) -> ClientStats:
        """Counts since this client began."""
        return self._outbox.stats()

    @property
    def first_rejection(self) -> str:
        """Reason why the map rejected a keyframe, for the first rejected one; empty without rejections."""
        return self._outbox.first_rejection

    @property
    def connected(self) -> bool:
        """True if the server has answered and has not fallen silent."""
        return self._outbox.link_state.is_connected

    @property
    def problem(self) -> str:
        """Reason why the spool or the server takes no keyframe at the moment; empty without a problem."""
        return "; ".join(filter(None, (self._outbox.spool_problem, self._link_problem())))

    def _link_problem(self) -> str:
        state = self._outbox.link_state
        if state.kind == "held":
            return state.why
        is_early = time.monotonic() - self._began < _SILENCE and (state.kind == "opening" or not state.why)
        return "" if state.is_connected or (is_early and not state.is_refused) else self._why()

    def close(self) -> None:
        """Stop sending. Call `flush` first: records in a temporary spool are lost (and logged).

        In a forked process this does nothing.
        """
        if os.getpid() != self._pid:
            return
        with self._sending:
            if self._closed:
                return
            self._closed = True
            self._outbox.wake_waiting()
            atexit.unregister(self.close)
            self._sender.stop()
            self._thread.join()
            waiting = self._outbox.describe_waiting()
            if self._outbox.close():
                log.error("%s lost: not acknowledged, and the spool was temporary", waiting)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_running(self) -> None:
        if self._closed:
            raise TransportError("the client is closed")
        if not self._thread.is_alive():
            raise TransportError("the client's sending thread has died")

    def _wait(self, reached: Callable[[], bool], timeout: float) -> bool:
        return self._outbox.wait(reached, timeout, self._check_running)

    def _why(self) -> str:
        """Return, for a person, the reason why some records are not on the server."""
        box, last_heard = self._outbox, self._sender.last_heard
        if box.link_state.why:
            return box.link_state.why
        silence = time.monotonic() - last_heard
        if not last_heard:
            return f"no server answers at {self._address} (control {self._control})"
        why = "the server is behind"
        if silence > _SILENCE:
            why = f"nothing was heard from the server at {self._control} for {silence:.1f} s"
        return why
