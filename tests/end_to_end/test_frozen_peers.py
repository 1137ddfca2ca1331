# SPDX-License-Identifier: MIT
"""Peers that stand still, double, speak another version or live in another time: each has a named outcome."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from bad_network import Proxy
from clients_and_spools import NOBODY, send_all
from keyframes_and_servers import DEADLINE, Server, connected, serving, until, wall
from quick_fusers import SUMS
from sum_map import hash_of

from lab.reliability.delivery_verdict import verify
from lab.reliability.scanner_process import Plan, Report, journals, numbers
from lab.reliability.supervisors import SCANNER
from tsfusion import Client, journal
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import FlushTimeout, ServerUnreachable, TransportError
from tsfusion.delivery import control_session, sender, spool
from tsfusion.journal.state_folder import find_journal
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import VERSION
from tsfusion.wire.sockets import sockets

FREEZE = 1.5  # seconds: longer than `stall_timeout`
QUICK = ClientConfig(policy="spool_all", stall_timeout=0.5)
FUSER = SUMS  # which keyframes are in the map is all that matters here


@pytest.fixture(autouse=True)
def noticed_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client of this process takes half a second of silence for an absence, not two seconds."""
    monkeypatch.setattr(sender, "_LEAST_SILENCE", 0.5)


@contextmanager
def frozen(pid: int) -> Iterator[None]:
    """A process stands still for as long as the block lasts."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def stream(client: Client, numbers: range, seconds: float) -> threading.Thread:
    """Send them over so many seconds, in a thread."""
    pause = threading.Event()

    def send() -> None:
        for i in numbers:
            client.send(wall(i, captured_ns=time.monotonic_ns()))
            pause.wait(seconds / len(numbers))

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def outcome(server: Server, keyframes: int, state: Path) -> list[str]:
    """Wait until all are fused, stop the server, and list what is wrong with the journal and the map."""
    until(lambda: fetch_status(server.address).keyframes_fused >= keyframes)
    status = fetch_status(server.address)
    assert server.terminate() == 0
    return verify(state, keyframes, status.map_hash, sums=True)


# --- standing still ---


def test_a_frozen_server_is_missed_and_catches_up(tmp_path: Path) -> None:
    state = tmp_path / "state"
    with serving(state, fuser=FUSER) as server, Client(server.address, config=QUICK) as client:
        client.send(wall(0))
        client.flush(timeout=DEADLINE)
        sending = stream(client, range(1, 41), FREEZE)
        with frozen(server.process.pid):
            until(lambda: not client.connected)
            with pytest.raises(
                FlushTimeout, match=r"nothing was heard from the server|takes the connection, but"
            ):
                client.flush(timeout=FREEZE)
        sending.join(DEADLINE)
        client.wait_fused(timeout=DEADLINE)
        assert client.connected
        assert client.stats.fused == 41
        assert outcome(server, 41, state) == []


def test_a_frozen_scanner_holds_nobody_up(tmp_path: Path) -> None:
    state, report = tmp_path / "state", tmp_path / "report"
    with serving(state, fuser=FUSER) as server, Client(server.address, config=QUICK) as client:
        plan = Plan(
            address=server.address, spool=str(tmp_path / "spool"), state=str(state), count=60, rate=30,
            report=str(report),
        )  # fmt: skip
        scanner = subprocess.Popen([sys.executable, str(SCANNER), msgspec.json.encode(plan).decode()])
        until(lambda: fetch_status(server.address).keyframes_durable > 10)
        with frozen(scanner.pid):
            ends = time.monotonic() + FREEZE
            for i in range(60, 10_000):
                client.send(wall(i))
                client.wait_fused(timeout=DEADLINE)
                if time.monotonic() > ends:
                    break
        assert scanner.wait(DEADLINE) == 0
        result = msgspec.json.decode(report.read_bytes(), type=Report)
        assert (result.fused, result.refused, result.rejected) == (60, {}, {})
        assert outcome(server, i + 1, state) == []


@pytest.mark.nightly
def test_a_frozen_fuser_is_waited_for(tmp_path: Path) -> None:
    state = tmp_path / "state"
    with serving(state, fuser=FUSER) as server, Client(server.address, config=QUICK) as client:
        client.send(wall(0))
        client.wait_fused(timeout=DEADLINE)
        with frozen(server.fuser_pid()):
            sending = stream(client, range(1, 31), FREEZE)
            sending.join(DEADLINE)
            client.flush(timeout=DEADLINE)
        client.wait_fused(timeout=DEADLINE)
        assert fetch_status(server.address).fuser_restarts == 0
        assert outcome(server, 31, state) == []


@pytest.mark.nightly
def test_a_fuser_that_stands_still_is_replaced(tmp_path: Path) -> None:
    state = tmp_path / "state"
    with (
        serving(state, fuser=FUSER, fuser_timeout=1.0, checkpoint_every=3) as server,
        Client(server.address, config=QUICK) as client,
    ):
        send_all(client, range(10))
        client.wait_fused(timeout=DEADLINE)
        os.kill(server.fuser_pid(), signal.SIGSTOP)  # and never goes on
        send_all(client, range(10, 20))
        client.wait_fused(timeout=DEADLINE)
        assert fetch_status(server.address).fuser_restarts >= 1  # more where the machine is slow
        assert outcome(server, 20, state) == []


# --- one session, twice ---


def test_a_copied_spool_is_one_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The keyframes count once; a client with lower numbers learns why they are not taken."""
    monkeypatch.setattr(spool, "_RESTART_SPREAD", 1)  # here: who comes second
    state, spools = tmp_path / "state", [tmp_path / name for name in ("spool", "copy")]
    with Client(NOBODY, spool=spools[0]) as client:
        send_all(client, range(6))
    shutil.copytree(*spools)
    with serving(state, fuser=FUSER) as server:
        with Client(server.address, spool=spools[0], config=QUICK) as first:
            assert first.send(wall(6)) > 6
            first.wait_fused(timeout=DEADLINE)
            with Client(server.address, spool=spools[1], config=QUICK) as second:
                second.send(wall(7))
                until(lambda: "another scanner" in second.problem)
                with pytest.raises(FlushTimeout, match="another scanner works with a copy of"):
                    second.flush(timeout=0.1)
                assert second.stats.waiting > 0
            first.send(wall(7))
            first.wait_fused(timeout=DEADLINE)
        assert fetch_status(server.address).sessions == 1
        assert outcome(server, 8, state) == []
    assert 7 in numbers(spools[1]), "what was not taken stays in its spool"


@pytest.mark.nightly
def test_two_that_share_a_session_at_once_spoil_nothing(tmp_path: Path) -> None:
    """Both go on with numbers of their own; lower ones are not taken, which is reported: nothing is lost."""
    state, spools = tmp_path / "state", [tmp_path / name for name in ("spool", "copy")]
    with Client(NOBODY, spool=spools[0]) as client:
        client.send(wall(0))
    shutil.copytree(*spools)
    with serving(state, fuser=FUSER) as server:
        scanners = [Client(server.address, spool=folder, config=QUICK) for folder in spools]
        sending = [stream(scanner, range(i, 41, 2), 0.5) for i, scanner in enumerate(scanners, start=1)]
        for thread in sending:
            thread.join(DEADLINE)
        for scanner in scanners:
            with contextlib.suppress(FlushTimeout):
                scanner.flush(timeout=1.0)
            scanner.close()
        until(lambda: (status := fetch_status(server.address)).keyframes_fused == status.keyframes_durable)
        status = fetch_status(server.address)
        assert server.terminate() == 0
    (folder,) = journals(state)
    found = numbers(folder)
    assert found[0] == 0
    assert len(found) == len(set(found)) == status.keyframes_fused
    kept = {number for folder in spools if journal.segments(folder) for number in numbers(folder)}
    assert {*found, *kept} == set(range(41))
    assert hash_of(map(wall, found)) == status.map_hash


# --- another version ---


def test_another_version_is_named(shared: Server) -> None:
    before = fetch_status(shared.address)
    hello = messages.Hello(os.urandom(16), messages.PROTOCOL_VERSION + 1)
    with connected(sockets.dealer, shared.control) as stranger:
        stranger.send(messages.encode(hello))
        assert stranger.poll(10_000)
        answer = messages.decode_to_client(stranger.recv())
    assert isinstance(answer, messages.Denied)
    assert answer.reason == "version"
    frames = codec.encode(wall(), session=hello.session, seq=1, jpeg_quality=90)
    newer = [b"TSF" + bytes([VERSION + 1]) + frames[0][4:], *frames[1:]]
    with connected(sockets.push, shared.address) as push:
        assert push.poll(10_000, 2)
        push.send_multipart(newer)
        wanted = before.messages_refused.get("version", 0) + 1
        until(lambda: fetch_status(shared.address).messages_refused.get("version", 0) == wanted)
    assert fetch_status(shared.address).keyframes_durable == before.keyframes_durable


def test_a_client_of_another_version_says_so(shared: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control_session, "PROTOCOL_VERSION", messages.PROTOCOL_VERSION - 1)
    with (
        Client(shared.address) as client,
        pytest.raises(
            ServerUnreachable, match=r"version 3 of the wire format, this client 2: update the older one"
        ),
    ):
        client.connect(timeout=0.5)


# --- another time ---

_JUMPING = """
import time as _time
_now, _now_ns, _began = _time.time, _time.time_ns, _time.monotonic()
def _jump():  # a day back after 0.3 s, and back again after 0.6 s, and so on
    return 86400 * (int((_time.monotonic() - _began) / 0.3) % 2)
_time.time = lambda: _now() - _jump()
_time.time_ns = lambda: _now_ns() - _jump() * 10**9
"""


def test_a_clock_that_jumps_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = time.time_ns
    monkeypatch.setattr(
        time, "time_ns", lambda: real() - 86400 * 10**9 * (time.monotonic_ns() // (3 * 10**8) % 2)
    )
    state = tmp_path / "state"
    with serving(state, fuser=FUSER, code=_JUMPING) as server, Client(server.address, config=QUICK) as client:
        stream(client, range(30), 1.0).join(DEADLINE)
        client.wait_fused(timeout=DEADLINE)
        delays = [times.fused_ns - times.captured_ns for times in client.records]
        assert all(0 < delay < 60e9 for delay in delays), delays
        server.kill()
    with serving(state, fuser=FUSER, code=_JUMPING) as server:
        assert outcome(server, 30, state) == []
    logged = [record.logged_ns for path in find_journal(state).files() for record in journal.records(path)]
    assert logged != sorted(logged), "the clock has not jumped"


def test_status_of_a_frozen_server_is_a_clear_error(shared: Server) -> None:
    with (
        frozen(shared.process.pid),
        pytest.raises(TransportError, match=r"no server answered at tcp://.* within 0\.5 s"),
    ):
        fetch_status(shared.address, timeout=0.5)


# --- late ---


def test_what_was_sent_again_counts_once(tmp_path: Path) -> None:
    """The connection hangs; the client opens another, and what hung comes after all."""
    state = tmp_path / "state"
    with serving(state, fuser=FUSER) as server, Proxy() as proxy:
        proxy.target(server.address, server.control)
        with Client(proxy.address, spool=tmp_path / "spool", config=QUICK) as client:
            client.send(wall(0))
            client.flush(timeout=DEADLINE)
            proxy.jam(True)
            send_all(client, range(1, 6))
            client.flush(timeout=DEADLINE)
            assert fetch_health(server.address).duplicates == 0
            proxy.jam(False)
            until(lambda: fetch_health(server.address).duplicates == 5)
            client.wait_fused(timeout=DEADLINE)
        status = fetch_status(server.address)
        assert server.terminate() == 0
    assert verify(state, 6, status.map_hash, sums=True) == []
