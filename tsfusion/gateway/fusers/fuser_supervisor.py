# SPDX-License-Identifier: MIT
"""Supervisor of a map's fuser process: starts the process, gives it work, and replaces it after failures."""

import logging
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import zmq

from tsfusion.core import logs, process
from tsfusion.core.config import CacheConfig, ServerConfig, VolumeConfig
from tsfusion.core.errors import MapError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.fusers.spare_fusers import SpareFusers
from tsfusion.gateway.ports.fuser_process import FuserProcess

log = logging.getLogger(__name__)

_MAX_IN_FLIGHT = 4  # records handed out without an answer: this hides the gateway's disk waits
_MAX_EARLY_DEATHS = 3  # in a row, before the map counts as failed
_LONGEST_PAUSE = 60.0  # seconds between one start and the next
_END_DEADLINE = 5.0  # seconds
# A keyframe is given up after two crashes of the process that works at it, or six kills from outside. So many
# kills do not hit the same keyframe by chance.
GIVE_UP_AT = 6
CRASH_WEIGHT = 3
KILL_WEIGHT = 1
_STEADY_AFTER = 60.0  # seconds of fusing, after which earlier deaths no longer count
_BETWEEN_KEYFRAMES = 10  # times `fuser_timeout` for a mesh or a checkpoint, which may take longer
STANDS_STILL_AFTER = 5.0  # seconds at one keyframe, stopped, or waiting for a disk: more is a problem
_INTERVAL = 0.25  # seconds between two checks
_LONGEST_STEP = 1.0  # most seconds that one check counts: for the rest, the gateway itself was suspended


class FuserSilence:
    """Seconds since a process answered, split by the state of the process. Call `look` again and again.

    A process that is stopped (SIGSTOP, a debugger), or that waits for a disk, does no work: its keyframe is
    not to blame. The same holds while the gateway is suspended, too, with the machine or the container.
    """

    def __init__(self) -> None:
        self._looked = time.monotonic()
        self.answered()

    def answered(self) -> None:
        """Reset all seconds to 0: the process has answered, or has nothing to answer."""
        self.working = self.stopped = self.disk = 0.0

    def look(self, watched: FuserProcess, *, owes: bool) -> None:
        """Add the seconds since the last call to the count of the process's present state.

        Args:
            watched: the process.
            owes: True if the process has something to answer. `stopped` counts in any case.
        """
        now = time.monotonic()
        if now - self._looked < _INTERVAL:
            return
        step, self._looked = min(now - self._looked, _LONGEST_STEP), now
        state = watched.state
        if state in ("T", "t"):
            self.stopped += step
            return
        self.stopped = 0.0
        if not owes:
            self.answered()
        elif state == "D":
            self.disk += step
        else:
            self.working += step


class FuserSupervisor:
    """Supervisor of one map's fuser: it runs one process after another.

    Args:
        ahead: folder in which the map is read first; `begin_work` ends that, once the map is in `folder`.

    Attributes:
        process: the present process.
        is_prepared: True if the map was read ahead.
        waits: True if no process was started yet.
    """

    def __init__(
        self,
        spares: SpareFusers,
        folder: Path,
        server: ServerConfig,
        volume: VolumeConfig,
        *,
        ahead: Path | None = None,
        waits: bool = False,
    ) -> None:
        self._map, self.waits = folder.name, waits
        self._server, self._ahead = server, ahead
        self._spares = spares
        self._begin = fuser_messages.Begin(
            str(folder),
            volume,
            server.mesh_interval,
            server.checkpoint_every,
            "",  # working file: each process has its own
            server.journal_bytes is not None,
            server.fuser_memory_bytes or process.physical_memory_bytes() * 3 // 4,
            server.quota_cost,
            server.quota_map,
            keep_seconds=server.keep_seconds,
            keep_keyframes=server.keep_keyframes,
            keep_radius=server.keep_radius,
            cache=_cache(server, folder if ahead is None else folder.parent),  # on the same disk
            is_private=server.is_private,
        )
        self.is_prepared = False
        self._early_deaths = 0  # in a row, of processes that were not at work on a keyframe
        self._blame: dict[int, int] = {}  # index of a keyframe → weight of the deaths at it
        self.finishing = self._finish_sent = False
        self.restarts = 0
        self.failed = ""  # why no process stays alive; empty if one does. Starts are tried ever more rarely
        self.stuck = ""  # why its next record cannot be read for now; empty if it can
        self._was_ready = False
        try:
            self._start()
        except OSError as error:
            raise MapError(f"the fuser process of map {self._map} cannot be started: {error}") from error

    def _start(self) -> None:
        self.process = self._spares.take(self._map, self._begin.volume, waits=self.waits)
        self.is_prepared = False
        self.ready = False  # True once the process has opened the map and compiled the kernels
        self.stuck = ""
        self._restart_at = 0.0
        self._silence = FuserSilence()
        self._last_message = self._ready_since = time.monotonic()
        self._oom_kills = process.oom_kills()
        self.in_flight: deque[int] = deque()  # indices of records without an answer, oldest first
        if self.process.has_started:
            self._send_begin()

    def begin(self) -> None:
        """Start the process if it waits for its start. A failed start is tried again a second later."""
        if not self.waits or time.monotonic() < self._restart_at:
            return
        try:
            self.process.start()
        except OSError as error:
            self._note_no_start(error)
            return
        self.waits, self.failed, self._restart_at = False, "", 0.0
        self._silence = FuserSilence()

    def give_process(self) -> FuserProcess:
        """Give the process away, for another map, and return it. This map's next one waits for `begin`."""
        given, self.waits = self.process, True
        self._start()
        return given

    def _note_no_start(self, error: OSError) -> None:
        self.failed = f"its fuser process cannot be started: {error}"
        self._restart_at = time.monotonic() + 1.0

    def _send_begin(self) -> None:
        """Send the process the order to open its map. Its message queue is empty, so this cannot fail."""
        if self._ahead is None:
            self.send(msgspec.structs.replace(self._begin, working=self.process.working_file))
        else:
            self.send(fuser_messages.ReadAhead(msgspec.structs.replace(self._begin, folder=str(self._ahead))))

    def begin_work(self) -> None:
        """Order the process to work at the map, which was read ahead and is now in its own folder."""
        self._ahead = None
        if self.process.has_started:
            self._send_begin()

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def volume(self) -> VolumeConfig:
        return self._begin.volume

    @property
    def keeps_window(self) -> bool:
        """True if settings (`keep_…`) make the map forget keyframes that are old, far away, or too many."""
        return self._begin.keeps_window

    @property
    def problem(self) -> str:
        """Reason why no keyframe is fused now, and what to do; empty without a problem."""
        if self.failed or self._restart_at:
            return self.failed
        if self.stuck:
            return self.stuck
        silence, timeout = self._silence, self._server.fuser_timeout
        process_ = f"its fuser (process {self.pid})"
        if silence.stopped >= min(STANDS_STILL_AFTER, timeout / 2):
            return (
                f"{process_} is stopped from outside, as by SIGSTOP or a debugger: let it go on (kill -CONT "
                f"{self.pid}); another takes over after {timeout:g} s"
            )
        if silence.disk >= STANDS_STILL_AFTER:
            return f"{process_} waits for a disk that does not answer: look at the disk of its map's folder"
        patience = timeout / 2 if self._server.is_private else STANDS_STILL_AFTER  # it may compile kernels
        if self._at_keyframe and silence.working >= patience:
            return f"{process_} is still at the same keyframe; another takes over after {timeout:g} s"
        return ""

    @property
    def _at_keyframe(self) -> bool:
        return self.process.current_keyframe != fuser_messages.NOT_WORKING

    @property
    def idle(self) -> bool:
        """True if the process is ready and has answered every record that it got."""
        return self.ready and not self.in_flight

    @property
    def seconds_at_work(self) -> float:
        """Seconds since the fuser's last answer while it has records to answer; else 0."""
        return time.monotonic() - self._last_message if self.ready and self.in_flight else 0.0

    @property
    def wants_work(self) -> bool:
        """True if the fuser can get another record now."""
        return self.ready and not self.finishing and len(self.in_flight) < _MAX_IN_FLIGHT

    def send(self, message: fuser_messages.ToFuser, frames: Sequence[Any] = ()) -> bool:
        """Send the fuser a message; see `FuserProcess.send`."""
        return self.process.send(message, frames)

    def fuse(self, order: fuser_messages.Fuse) -> bool:
        """Send the fuser an order to fuse a record. Return False if it has to be sent again later."""
        if self._blame.get(order.index, 0) >= GIVE_UP_AT:
            order = msgspec.structs.replace(order, skip="crash")
        if not self.send(order):
            return False
        if not self.in_flight:
            self._silence.answered()
        self.in_flight.append(order.index)
        return True

    def receive(self) -> tuple[fuser_messages.ToGateway, Sequence[zmq.Frame]] | None:
        """Return the fuser's next message and its frames, or None.

        Raises:
            TsfusionError: when the fuser cannot open the map.
        """
        if self._restart_at:  # the process is dead: keyframes of unread answers are fused once more
            return None
        if (received := self.process.receive()) is None:
            return None
        self._last_message = time.monotonic()
        self._silence.answered()
        message, _ = received
        if isinstance(message, fuser_messages.Failed) and self._was_ready:
            log.error("the fuser cannot open the map: %s", message.message)
        elif isinstance(message, fuser_messages.Failed):
            raise message.error()
        if isinstance(message, fuser_messages.Started):
            self.process.note_start()
            self._send_begin()
        elif isinstance(message, fuser_messages.Prepared):
            self.is_prepared = True
        elif isinstance(message, fuser_messages.Ready):
            self.ready = self._was_ready = True
            self._ready_since = self._last_message
        elif isinstance(message, fuser_messages.Done):
            self.in_flight.popleft()
            if self._blame.get(message.index, 0) < GIVE_UP_AT:  # a keyframe that is given up stays so
                self._blame.pop(message.index, None)
            self.failed = self.stuck = ""
            if self._last_message - self._ready_since > _STEADY_AFTER:
                self._early_deaths = 0
        elif isinstance(message, fuser_messages.Stuck):
            self.stuck = message.message
        elif isinstance(message, fuser_messages.Saved) and message.written:
            self._early_deaths = 0
            self._blame.pop(fuser_messages.MOVING, None)
        return received

    def ended(self) -> bool:
        """Kill the process if it hangs. Return True once it has ended."""
        if self.process.status is not None:
            return True
        busy = bool(self.in_flight) or self._finish_sent
        self._silence.look(self.process, owes=busy and self.ready)
        timeout = self._server.fuser_timeout
        if (busy or not self.ready) and self._silence.stopped > timeout:
            return self._replace(f"the fuser process has been stopped for {timeout:.0f} s", blame=0)
        if not self._at_keyframe:
            timeout *= _BETWEEN_KEYFRAMES
        if self._silence.working > timeout:
            return self._replace(f"the fuser process has been silent for {timeout:.0f} s", blame=CRASH_WEIGHT)
        return False

    def _replace(self, why: str, *, blame: int) -> bool:
        """Log `why`, and kill a hanging process. Return True once it has ended: then the next one starts."""
        log.error("%s: it is killed", why, extra=logs.about(map=self._map))
        self._blame_current_keyframe(blame)
        self._silence.answered()
        self.process.kill()
        return self.process.status is not None

    def restart(self) -> None:
        """Start a new process after the end of one. After repeated deaths, wait before the start.

        The new process begins at the last checkpoint. Call this until `ended` returns False.

        Raises:
            MapError: when the very first process died before it was ready.
        """
        if not self._restart_at:
            self._on_death()
        if time.monotonic() < self._restart_at:
            return
        dead = self.process
        try:
            self._start()
        except OSError as error:
            self._note_no_start(error)
            return
        dead.close()
        self.restarts += 1

    def _on_death(self) -> None:
        """Find the reason why the process ended, log it, and set the time of the next start."""
        status = self.process.status
        killed = status == -signal.SIGKILL and process.oom_kills() == self._oom_kills
        if not self.ready and self.restarts == 0 and not killed:
            raise MapError(f"the fuser process ended with status {status} before it was ready")
        blamed = self._blame_current_keyframe(KILL_WEIGHT if killed else CRASH_WEIGHT)
        pause = 0.0
        if not blamed and not killed:
            if self._early_deaths >= _MAX_EARLY_DEATHS:
                self.failed = (
                    f"its fuser process ended {self._early_deaths} times, last with status {status}: the log "
                    "says why; keyframes are journaled, and it is tried again every minute"
                )
            pause = min(2.0**self._early_deaths - 1, _LONGEST_PAUSE)
            self._early_deaths += 1
        self.in_flight.clear()
        self.ready = False
        self._restart_at = time.monotonic() + pause
        log.error(
            "the fuser process ended with status %s; another takes over from the checkpoint%s",
            status,
            f" in {pause:.0f} s" if pause else "",
            extra=logs.about(map=self._map),
        )

    def _blame_current_keyframe(self, weight: int) -> bool:
        """Blame the process's end on its current keyframe, by `weight`. Return False without a keyframe."""
        index = self.process.current_keyframe
        if index == fuser_messages.NOT_WORKING:
            return False
        self._blame[index] = self._blame.get(index, 0) + weight
        if index == fuser_messages.MOVING and self._blame[index] >= GIVE_UP_AT and self._begin.moves:
            self._begin = msgspec.structs.replace(self._begin, moves=False)
            log.error(
                "the fuser process died again and again while it moved corrected keyframes: they stay where "
                "they were fused until the server starts anew",
                extra=logs.about(map=self._map),
            )
        with suppress(OSError):
            self.process.clear_current_keyframe()
        return True

    def finish(self) -> None:
        """Order the process to write a checkpoint and end. Call it until `ended`: the queue may be full."""
        if not self._finish_sent:
            self._finish_sent = self.send(fuser_messages.Finish())
            self._silence.answered()
        self.finishing = True

    @property
    def finished_well(self) -> bool:
        """True if the process has ended with its checkpoint on the disk."""
        return self.finishing and self.process.status == 0

    def close(self, *, wait: bool = True) -> None:
        """End the process. What its checkpoint lacks is fused again from the journal by the next one.

        Args:
            wait: wait some seconds for its end; else the next process waits for the lock of the map's folder.
        """
        self.process.close(_END_DEADLINE if self.ready and wait else 0.0, wait=wait)


def _cache(server: ServerConfig, folder: Path) -> CacheConfig | None:
    """Return the settings of the disk cache for a map's blocks, or None without one."""
    if server.fuser_disk_bytes is None:
        return None
    return CacheConfig(
        folder=str(server.cache or folder),
        disk_bytes=server.fuser_disk_bytes,
        min_free_bytes=server.min_free_bytes,
    )
