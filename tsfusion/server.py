# SPDX-License-Identifier: MIT
"""Run the server: a gateway, which takes and journals keyframes, and one fuser process for each map."""

import logging
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import zmq

from tsfusion.core import process
from tsfusion.core.config import DEFAULT_MAP, ServerConfig, VolumeConfig
from tsfusion.core.folder_lock import lock_folder
from tsfusion.core.service_manager import Watchdog
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.loop import GatewayLoop
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.metrics_page import MetricsPage
from tsfusion.journal import state_folder
from tsfusion.wire.messages.health import Health
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.sockets import Addresses

log = logging.getLogger(__name__)

_SECOND_SIGNAL = 1.0  # seconds after the first
_REPORT_INTERVAL = 0.5  # seconds between two reports of the start's progress
_LOG_INTERVAL = 5.0  # seconds between two lines about the start's progress in the log


def run(
    server: ServerConfig,
    volume: VolumeConfig,
    on_ready: Callable[[Addresses], None] | None = None,
    *,
    volumes: Mapping[str, VolumeConfig] | None = None,
    guest: str | None = None,
    on_health: Callable[[Health], None] = lambda _: None,
) -> int:
    """Serve until SIGTERM or SIGINT, then drain the journals into the maps and write checkpoints.

    A second signal, a second or more after the first, skips the drain; the next start fuses the rest. Call
    `run` from the main thread.

    Args:
        server: settings of the server; port 0 in `listen` draws a random one.
        volume: settings of every map that has no settings of its own.
        on_ready: called once with the real addresses, when keyframes are accepted and kernels are warm.
        volumes: maps with settings of their own, opened at the start. Other maps of the state folder are
            opened afterwards, one after the other, or as soon as a client asks for one.
        guest: public key with the right to watch every map, in addition to the server's allow-list.
        on_health: called with the server's health about once a second.

    Returns:
        The exit status: 0, or 1 when a checkpoint was not written.

    Raises:
        TsfusionError: when the server cannot start (port taken, state folder unwritable or in use, a map of
            other settings, an address that others can reach without keys).
    """
    _check_addresses(server)
    with ExitStack() as stack:
        signals = stack.enter_context(_signals())
        try:
            loop, watchdog, report = _open(
                stack,
                server,
                {DEFAULT_MAP: volume, **(volumes or {})},
                signals,
                guest=guest,
                on_health=on_health,
            )
        except _StoppedAtStart:
            return 0
        while not loop.gateway.maps.warm:
            loop.step()
            if signals:
                return 0
        addresses = loop.ports.bind()
        loop.gateway.accept(_advertised(addresses, server))
        report.is_started = True
        watchdog.ready(f"listening at {addresses.data}")
        if on_ready is not None:
            on_ready(addresses)
        return _serve(loop, signals, watchdog)


def _open(
    stack: ExitStack,
    server: ServerConfig,
    volumes: dict[str, VolumeConfig],
    signals: list[int],
    *,
    guest: str | None,
    on_health: Callable[[Health], None],
) -> tuple[GatewayLoop, Watchdog, "_ReadingReport"]:
    process.raise_file_limit()
    state = Path(server.state)
    stack.enter_context(lock_folder(state, "state", "server"))
    for name in moved_maps.departed_names(state):
        moved_maps.put_aside(state, name)
    own = frozenset(volumes)
    for name in state_folder.map_names(state):
        if len(volumes) < server.max_maps and state_folder.holds_a_map(state_folder.map_folder(state, name)):
            volumes.setdefault(name, volumes[DEFAULT_MAP])
    loop, metrics = make_loop(stack, server, guest=guest, on_health=on_health)
    if server.metrics is not None:
        page = MetricsPage(server.metrics, metrics.pages)
        stack.callback(page.close)
        log.info("figures and health checks are at http://%s", page.address)
    watchdog = Watchdog()
    report = _ReadingReport(metrics, watchdog, signals)
    loop.gateway.maps.open_at_start(volumes, report, later=volumes.keys() - own)
    return loop, watchdog, report


def make_loop(
    stack: ExitStack,
    server: ServerConfig,
    *,
    guest: str | None = None,
    on_health: Callable[[Health], None] = lambda _: None,
) -> tuple[GatewayLoop, Metrics]:
    """Return the loop of a gateway without maps, and its metrics; the stack closes both. See `run`."""
    process.installed_engine()  # raises before any fuser starts
    context: zmq.Context[Any] = zmq.Context()
    stack.callback(context.destroy, 0)  # an error in between must not wait for a socket that was left open
    access = AccessControl(server.keys, guest=guest)
    metrics = Metrics(server)
    loop = GatewayLoop(context, server, access, metrics, on_health=on_health)
    stack.callback(loop.close)
    return loop, metrics


class _StoppedAtStart(Exception):
    """A signal to stop arrived before the server was ready."""


class _ReadingReport:
    """Progress of reading a map's journal, for the health checks, the service manager and the log."""

    def __init__(self, metrics: Metrics, watchdog: Watchdog, signals: list[int]) -> None:
        self._metrics = metrics
        self._watchdog = watchdog
        self._signals = signals
        self.is_started = False  # once True, signals are for the main loop, and the start is over
        self._next_report = 0.0
        self._next_line = time.monotonic() + _LOG_INTERVAL

    def __call__(self, map_name: str, done: int, total: int, records: int) -> None:
        """Report the progress of reading, at most twice a second.

        Raises:
            _StoppedAtStart: when a signal to stop has come.
        """
        if self._signals and not self.is_started:
            raise _StoppedAtStart
        now = time.monotonic()
        if now < self._next_report:
            return
        self._next_report = now + _REPORT_INTERVAL
        share = f"{100 * done // max(total, 1)} % of {total / 1e6:.0f} MB"
        text = f"reading the journal of map {map_name}: {share}, {records:,} records"
        self._metrics.report_start(text)
        if self.is_started:
            self._watchdog.pet()
        else:
            self._watchdog.starting(text)
        if now >= self._next_line:
            self._next_line = now + _LOG_INTERVAL
            log.info("%s", text)


def _serve(loop: GatewayLoop, signals: list[int], watchdog: Watchdog) -> int:
    gateway = loop.gateway
    while not signals:
        loop.step()
        watchdog.pet()
    log.info("ending: what is in the journals is fused and saved first")
    watchdog.stopping()
    gateway.stop_accepting()
    while not gateway.maps.ended and len(signals) == 1:
        loop.step()
        watchdog.pet()
    drained = gateway.maps.drained
    while not gateway.maps.finish() and len(signals) == 1:
        loop.step()
        watchdog.pet()
    return 0 if drained and gateway.maps.finished_well else 1


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Yield a list that collects the signals to stop, as they arrive."""
    came: list[int] = []
    last = 0.0

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal last
        # `timeout` and some supervisors signal a process and then its group: that is one request, not two.
        if not came or time.monotonic() - last > _SECOND_SIGNAL:
            came.append(number)
            last = time.monotonic()

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _advertised(addresses: Addresses, server: ServerConfig) -> Addresses:
    """Return the addresses by which clients on other machines reach this server."""
    if server.advertise is None:
        return addresses
    data = sockets.connect_address(server.advertise)
    return Addresses(data, sockets.control_address(data))


def _check_addresses(server: ServerConfig) -> None:
    """Raise for addresses that cannot be bound, before the kernels are compiled, which takes long."""
    for address in (server.listen, server.control):
        if address is not None:
            sockets.check_reachable(address, has_keys=server.keys is not None)
            sockets.check_free(address)
    if server.advertise is not None:
        sockets.control_address(sockets.connect_address(server.advertise))
    if server.control is None and sockets.parse_address(server.listen)[1]:
        sockets.check_free(sockets.control_address(server.listen))
