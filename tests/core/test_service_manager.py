# SPDX-License-Identifier: MIT
"""Messages to a service manager, read from the other end of a real datagram socket."""

import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from tsfusion.core.service_manager import Watchdog


class Manager:
    """A service manager's socket."""

    def __init__(self, address: str) -> None:
        self.environment = {"NOTIFY_SOCKET": address}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)

    def received(self) -> list[str]:
        """Messages since the last call."""
        messages = []
        while True:
            try:
                messages.append(self._socket.recv(65536).decode())
            except BlockingIOError:
                return messages

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    made = Manager(
        str(tmp_path / "notify") if request.param == "path" else f"@tsfusion-{secrets.token_hex(8)}"
    )
    yield made
    made.close()


def test_start_status_and_end_are_reported(manager: Manager) -> None:
    dog = Watchdog(manager.environment)
    dog.starting("reading the journal: 35 %")
    dog.ready("2 maps")
    dog.pet("2 maps")
    dog.pet("2 maps, 1 keyframe waiting")
    dog.stopping()
    dog.close()
    dog.pet("sent to nobody")
    assert manager.received() == [
        "EXTEND_TIMEOUT_USEC=120000000\nSTATUS=reading the journal: 35 %",
        "READY=1\nSTATUS=2 maps", "STATUS=2 maps, 1 keyframe waiting", "STOPPING=1",
    ]  # fmt: skip


def test_it_is_petted_twice_an_interval(manager: Manager) -> None:
    now = [50.0]
    dog = Watchdog({**manager.environment, "WATCHDOG_USEC": "10000000"}, lambda: now[0])
    assert dog.interval == 10.0
    received = []
    for _ in range(200):
        dog.pet()
        received += manager.received()
        now[0] += 0.1
    assert received == ["WATCHDOG=1"] * 4
    dog.close()


@pytest.mark.parametrize(
    ("given", "interval"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-1"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "2000000"}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, None),
    ],
)
def test_only_the_process_that_is_watched_is_petted(
    manager: Manager, given: dict[str, str], interval: float | None
) -> None:
    dog = Watchdog({**manager.environment, **given})
    assert dog.interval == interval
    dog.pet()
    assert manager.received() == (["WATCHDOG=1"] if interval else [])
    dog.close()


@pytest.mark.parametrize("address", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "vsock:2:1"}])
def test_without_a_manager_nothing_happens(address: dict[str, str], caplog: pytest.LogCaptureFixture) -> None:
    dog = Watchdog({**address, "WATCHDOG_USEC": "1"})
    dog.ready("x")
    dog.pet()
    dog.stopping()
    dog.close()
    assert dog.interval is None
    assert not caplog.records


def test_the_environment_is_what_counts(manager: Manager, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", manager.environment["NOTIFY_SOCKET"])
    dog = Watchdog()
    dog.ready()
    dog.close()
    assert manager.received() == ["READY=1"]


def test_a_status_is_one_line(manager: Manager) -> None:
    dog = Watchdog(manager.environment)
    dog.ready("disk full\nWATCHDOG=trigger \udc80" + "x" * 1000)
    (message,) = manager.received()
    assert len(message.splitlines()) == 2
    assert len(message) < 300
    dog.close()


def test_a_manager_that_went_away_or_does_not_read_stops_nobody(
    manager: Manager, caplog: pytest.LogCaptureFixture
) -> None:
    dog = Watchdog({**manager.environment, "WATCHDOG_USEC": "1"})
    for i in range(2000):  # more than its socket holds
        dog.pet(f"{i}")
    assert "cannot send" in caplog.text
    manager.close()
    caplog.clear()
    dog.stopping()
    assert "cannot send STOPPING=1" in caplog.text
    dog.close()
