# SPDX-License-Identifier: MIT
"""Servers and clients without file descriptors, without room on the disk, without files they had."""

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from clients_and_spools import NOBODY, QUICK, deliver, joined, send_all
from command_processes import alive
from keyframes_and_servers import DEADLINE, Server, connected, map_hash, serving, until, wall
from quick_fusers import SUMS
from scripted_server import scripted

from tsfusion import Client, Volume, VolumeConfig
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import InvalidKeyframe, KeyframeRefused
from tsfusion.datasets import Synthetic
from tsfusion.delivery import sender
from tsfusion.delivery.spool import Spool
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.sockets import sockets

FUSER = SUMS  # but where a map outgrows its memory

# --- scarce file descriptors, a full or vanishing disk ---


def test_a_server_out_of_file_descriptors_lives(tmp_path: Path) -> None:
    with serving(tmp_path / "state", fuser=FUSER) as server, Client(server.address, config=QUICK) as client:
        client.send(wall(0))
        client.wait_fused(timeout=DEADLINE)
        pid = server.process.pid
        before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        with connected(sockets.dealer, server.control) as link:
            assert link.poll(10_000, zmq.POLLOUT)
            used = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
            resource.prlimit(pid, resource.RLIMIT_NOFILE, (used, before[1]))
            link.send(messages.encode(Command(name="status")))
            assert link.poll(10_000)
            reply = messages.decode_to_client(link.recv())
        assert isinstance(reply, messages.Reply)
        assert reply.status is not None
        resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
        client.send(wall(1))
        client.wait_fused(timeout=DEADLINE)
        assert server.terminate() == 0


@contextmanager
def files_numbered_from(first: int) -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Give new files such numbers; of the two functions the one lets none be opened, the other any."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)

    def allow(count: int) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))

    held = [os.dup(0)]
    while held[-1] < first - 1:
        held.append(os.dup(0))
    try:
        yield lambda: allow(first), lambda: allow(soft)
    finally:
        allow(soft)
        for one in held:
            os.close(one)


def test_a_client_out_of_file_descriptors_waits_for_some(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "_LEAST_SILENCE", 0.5)
    with files_numbered_from(64) as (take_rest, give_back), scripted() as server, joined(server) as client:
        deliver(client, map(wall, range(3)))
        take_rest()
        server.deaf = True  # the client makes its connections anew
        until(lambda: "cannot open a socket: Too many open files" in client.problem)
        assert send_all(client, range(3, 5)) == [3, 4]
        give_back()
        server.deaf = False
        client.flush(DEADLINE)
        assert (client.problem, server.numbers) == ("", [*range(5)])


_FEW_FILES = """
import os, resource, signal, sys, zmq
from tsfusion import Client
from tsfusion.core.errors import JournalError, ServerUnreachable, TransportError
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink
from tsfusion.wire.asking.queries import fetch_health

def leave(free):
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
    held = []
    try:
        while True:
            held.append(os.dup(0))
    except OSError:
        for one in held[:free]:
            os.close(one)

def client(free):
    leave(free)
    Client("tcp://127.0.0.1:1", spool=sys.argv[1]).close()

def query(free):
    leave(free)
    try:
        fetch_health("tcp://127.0.0.1:1", timeout=0.1)
    except ServerUnreachable:
        pass

def connection(free):
    context = zmq.Context()
    context.socket(zmq.PAIR).close()
    leave(free)
    try:
        ServerLink(context, sockets.push, "tcp://127.0.0.1:1", None).close()
    finally:
        context.term()

for work, most in ((client, 24), (query, 16), (connection, 6)):
    for free in range(most):
        if not (child := os.fork()):
            signal.alarm(5)
            try:
                work(free)
                print("made", flush=True)
            except (TransportError, JournalError, zmq.ZMQError) as error:
                print(error, flush=True)
            os._exit(0)
        if status := os.waitpid(child, 0)[1]:
            print(f"{work.__name__}, {free} left: status {status}", flush=True)
"""


def test_too_few_file_descriptors_are_a_clear_error(tmp_path: Path) -> None:
    """Where libzmq gets too few for its threads, it ends the process: that must not come about."""
    command = [sys.executable, "-c", _FEW_FILES, str(tmp_path / "spool")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=DEADLINE).stdout
    assert [line for line in said.splitlines() if line != "made" and "Too many open files" not in line] == []
    assert said.count("cannot open a socket") > 3
    assert said.endswith("made\n")


def test_a_client_survives_the_loss_of_its_spool_files(
    shared: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "_LEAST_SILENCE", 0.5)
    small = ClientConfig(segment_bytes=1 << 16, stall_timeout=0.5, policy="spool_all")
    with Client(NOBODY, spool=tmp_path, config=small) as early:
        send_all(early, range(40))
    lost = sorted(tmp_path.glob("*.mcap"))[0]
    with Client(shared.address, spool=tmp_path, config=small) as client:
        lost.unlink()
        client.send(wall(41))
        client.wait_fused(timeout=DEADLINE)
        assert client.stats.durable + sum(client.stats.refused.values()) == 41


# --- memory ---


@pytest.mark.slow
def test_a_map_that_outgrows_its_memory_refuses_keyframes_and_lives(tmp_path: Path) -> None:
    """The map has what fitted, exactly; the rest is kept aside, and the fuser does not die of it."""
    room = Synthetic("room", sensor="kinect", count=8, seed=0)
    fine = VolumeConfig(voxel_size=0.004, threads=1)
    with (
        serving(tmp_path, fine, fuser_memory_bytes=1 << 28) as server,
        Client(server.address, policy="spool_all") as client,
    ):
        deliver(client, (room[i] for i in range(8)))
        full = fetch_health(server.address).maps["default"]
        assert 0 < client.stats.rejected["memory"] == full.rejected["memory"] == full.quarantined < 8
        assert full.fuser_restarts == 0
        assert server.terminate() == 0
    saved = Volume.load(tmp_path / "maps/default/map.tsf")
    kept = {int(path.name.split("-")[1]) for path in (tmp_path / "maps/default/quarantine").iterdir()}
    fitted = [room[i] for i in set(range(8)) - {seq - 1 for seq in kept}]
    assert map_hash(fitted, fine) == saved.map_hash()
    with serving(tmp_path, fine, fuser_memory_bytes=1 << 28) as server:  # as full as before
        until(lambda: fetch_health(server.address).maps["default"].state == "idle")
        again = fetch_health(server.address).maps["default"]
        assert (again.keyframes_fused, again.rejected) == (full.keyframes_fused, full.rejected)
        assert fetch_status(server.address, timeout=DEADLINE).map_hash == saved.map_hash()


# --- keyframes that cannot travel ---


def test_a_sensor_that_has_no_name_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(InvalidKeyframe, match=r"sensor must be a name of 1 to 32 characters, got 'xxxx"):
        wall(sensor="x" * 33)
    with pytest.raises(InvalidKeyframe, match="sensor must be a name"):
        wall(sensor=5)


def test_a_spooled_message_that_is_none_is_given_up(shared: Server, tmp_path: Path) -> None:
    spool = Spool(tmp_path, 1 << 20)
    spool.add(spool.write([b"rubbish", b"x"]))
    spool.close()
    with Client(shared.address, spool=tmp_path) as client:
        client.send(wall(5))
        with pytest.raises(KeyframeRefused, match=r"1 was refused \(spool\)"):
            client.flush(timeout=DEADLINE)
        client.wait_fused(timeout=DEADLINE)


# --- a server that is killed ---


def test_a_killed_server_leaves_no_socket_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="t", dir="/tmp") as short:  # a socket's path has to be short
        monkeypatch.setenv("TMPDIR", short)
        with serving(tmp_path / "state", fuser=FUSER) as server:
            assert list(Path(short).iterdir()) == []  # nothing waits for a cleaner end
            fuser = server.fuser_pid()
            server.kill()
            until(lambda: not alive(fuser))
        assert list(Path(short).iterdir()) == []
