# SPDX-License-Identifier: MIT
"""The gateway with fusers that misbehave, in this process; and real scans by file and by socket."""

import errno
import itertools
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq
from clients_and_spools import deliver
from failures import refuse
from idle_fuser import FuserThread, starting
from keyframes_and_servers import map_hash, serving, until

from tsfusion import Client, VolumeConfig, journal
from tsfusion.core import process
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import InvalidConfig, JournalError, MapError
from tsfusion.datasets import open_dataset
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.fusers import fuser_process, fuser_supervisor
from tsfusion.gateway.fusers.fuser_process import FuserProcess
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Ports
from tsfusion.journal import Journal, Position, state_folder
from tsfusion.wire.asking.queries import fetch_status
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.sockets import Addresses

_HEAD = """
import os, struct, sys, time, zmq
from tsfusion.fuser import fuser_messages
from tsfusion.wire.sockets import sockets

link = sockets.pair(zmq.Context())
link.connect(sys.argv[1])
"""
_FAKE = f"""{_HEAD}
def say(message):
    link.send(fuser_messages.encode(message))

def at(index):
    with open(begin.working, "r+b") as file:
        file.write(struct.pack("<q", index))

say(fuser_messages.Started())
while True:
    message = fuser_messages.to_fuser.decode(link.recv())
    if isinstance(message, fuser_messages.Begin):
        begin = message
    {{body}}
"""
_FUSES = """
    if isinstance(message, fuser_messages.Begin):
        say(fuser_messages.Ready({}))
    if isinstance(message, fuser_messages.Fuse):
        reason = message.skip
        if reason is None:
            at(message.index)
            special(message)
            at(-1)
        say(fuser_messages.Done(message.index, 1, 2, reason))
"""


def fusing(line: str) -> str:
    """A fuser that runs this line on each keyframe."""
    return _FUSES.replace("special(message)", line)


_CRASHES_ON_2 = fusing("if message.index == 2: sys.exit(7)")
_CANNOT_COME_BACK = """
    import pathlib
    mark = pathlib.Path(begin.folder) / "once"
    if mark.exists():
        sys.exit(9)
    mark.touch()
    say(fuser_messages.Ready({}))
    link.recv()
    sys.exit(7)
"""
_SLOW = """
    if isinstance(message, fuser_messages.Begin):
        say(fuser_messages.Ready({}))
        while not os.path.exists(GO):
            time.sleep(0.01)
    if isinstance(message, fuser_messages.Fuse):
        say(fuser_messages.Done(message.index, 1, 2))
    if isinstance(message, fuser_messages.Expire):
        time.sleep(0.0001)
    if isinstance(message, fuser_messages.Finish):
        sys.exit(0)
"""

Start = Callable[..., Gateway]


def fuser_running(body: str) -> tuple[str, ...]:
    """The command of a fuser that runs these lines on each message."""
    return sys.executable, "-c", _FAKE.replace("{body}", body)


class ScriptedThread(FuserThread):
    """A fuser of `fuser_running` in a thread, where its lines neither hang nor use signals."""

    def work(self) -> int:
        context: zmq.Context[Any] = zmq.Context()
        link = sockets.pair(context)
        link.connect(self.endpoint)

        def receive() -> bytes:
            while not link.poll(20):
                if self.over.is_set():
                    sys.exit(-signal.SIGKILL)
            return link.recv()

        modules = {"os": os, "struct": struct, "sys": sys, "time": time, "fuser_messages": fuser_messages}
        names = {**modules, "link": SimpleNamespace(send=link.send, recv=receive)}
        try:
            exec(self.command[2].removeprefix(_HEAD), names)
        except SystemExit as ended:
            return int(str(ended.code))
        finally:
            link.close(linger=0)
            context.term()
        return 0


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """A gateway over five journaled records, with a fuser that runs the given lines on each message."""
    with ExitStack() as stack:

        def begin(body: str, *, processes: bool = False, **settings: Any) -> Gateway:
            monkeypatch.setattr(fuser_process, "COMMAND", fuser_running(body))
            if not processes:
                monkeypatch.setattr(fuser_process, "subprocess", starting(ScriptedThread))
            monkeypatch.setattr(fuser_supervisor, "_END_DEADLINE", 0.1)
            writer = Journal(state_folder.map_folder(tmp_path, "default") / "journal", 1 << 20)
            for i in range(5):
                writer.append([b"head", b"body"], session=bytes(16), seq=i + 1)
            writer.close()
            server = ServerConfig(**{"state": str(tmp_path), "memory_bytes": 1 << 40, **settings})
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            stack.callback(context.term)
            access = AccessControl(context, None)
            ports = Ports(context, server)
            stack.callback(ports.close)
            gateway = Gateway(context, server, ports, access, Metrics())
            stack.callback(gateway.maps.close)
            gateway.maps.open_at_start({"default": VolumeConfig()})
            return gateway

        yield begin


def stepped(gateway: Gateway, reached: Callable[[], bool]) -> None:
    def step() -> bool:
        gateway.step()
        return reached()

    until(step)


def drained(gateway: Gateway) -> Gateway:
    stepped(gateway, lambda: gateway.maps.drained)
    return gateway


def default(gateway: Gateway) -> MapHealth:
    return gateway.health().maps["default"]


def test_a_keyframe_that_kills_the_fuser_twice_is_quarantined(
    start: Start, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    health = default(drained(start(_CRASHES_ON_2)))
    assert (health.fuser_restarts, health.rejected, health.quarantined) == (2, {"crash": 1}, 1)
    assert (health.keyframes_fused, health.keyframes_durable) == (4, 5)
    said = caplog.records[-1]
    assert said.getMessage() == "a keyframe is not in the map: crash"
    assert {"map": "default", "seq": 3, "reason": "crash"}.items() <= vars(said)["about"].items()
    (kept,) = (state_folder.map_folder(tmp_path, "default") / "quarantine").iterdir()
    assert kept.name == "00000000-3-crash.mcap"
    (record,) = journal.records(kept)
    assert (record.seq, [bytes(frame) for frame in record.frames]) == (3, [b"head", b"body"])


def test_a_fuser_that_is_killed_is_not_the_keyframes_fault(start: Start, tmp_path: Path) -> None:
    """Somebody kills it three times at the same keyframe: that says nothing about the keyframe."""
    body = fusing(
        f"""
            with open({str(tmp_path / "kills")!r}, "a+") as kills:
                kills.seek(0)
                if message.index == 2 and len(kills.read()) < 3:
                    kills.write("x")
                    kills.close()
                    os.kill(os.getpid(), 9)
        """.strip()
    )
    gateway = drained(start(body, processes=True))
    health, (hosted,) = default(gateway), gateway.maps
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (3, {}, 5)
    assert hosted.fuser._blame == {}  # it is fused


def test_a_fuser_that_goes_on_for_long_is_steady_and_gets_few_keyframes_at_once(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuser_supervisor, "_STEADY_AFTER", -1.0)
    gateway = start(fusing("pass"))
    (hosted,) = gateway.maps
    hosted.fuser._early_deaths = 3
    drained(gateway)
    assert hosted.fuser._early_deaths == 0
    assert hosted.fuser.wants_work
    hosted.fuser.in_flight.extend(range(4))
    assert not hosted.fuser.wants_work


def test_what_is_done_between_keyframes_may_take_longer(start: Start) -> None:
    """A mesh, a checkpoint."""
    body = fusing("(at(-1), time.sleep(1.2)) if message.index == 1 else None")
    assert default(drained(start(body, fuser_timeout=0.6))).fuser_restarts == 0


def test_a_fuser_that_takes_all_memory_at_a_keyframe_crashes_at_it(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system kills it, and counts that."""
    monkeypatch.setattr(process, "oom_kills", itertools.count().__next__)
    health = default(drained(start(fusing("if message.index == 2: os.kill(os.getpid(), 9)"), processes=True)))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


def test_a_fuser_that_is_stopped_is_not_the_keyframes_fault(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody stops it three times at the same keyframe, and never lets it go on."""
    monkeypatch.setattr(fuser_supervisor, "KILL_WEIGHT", fuser_supervisor.GIVE_UP_AT)
    body = fusing(
        f"""
            with open({str(tmp_path / "stops")!r}, "a+") as stops:
                stops.seek(0)
                if message.index == 2 and len(stops.read()) < 3:
                    stops.write("x")
                    stops.close()
                    os.kill(os.getpid(), 19)
        """.strip()
    )
    gateway = start(body, processes=True, fuser_timeout=0.8)
    gateway.accept(Addresses("", ""))
    stepped(gateway, lambda: "is stopped from outside" in default(gateway).problem)
    assert not gateway.health().ready
    health = default(drained(gateway))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (3, {}, 5)
    assert health.problem == ""


def test_a_stopped_fuser_that_goes_on_is_waited_for(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuser_supervisor, "STANDS_STILL_AFTER", 0.3)
    mark = tmp_path / "stopped"
    line = f"if message.index == 2: open({str(mark)!r}, 'w').close(); os.kill(os.getpid(), 19)"
    gateway = start(fusing(line), processes=True, fuser_timeout=600.0)
    stepped(gateway, mark.exists)
    (hosted,) = gateway.maps
    stepped(gateway, lambda: "is stopped" in hosted.fuser.problem)
    os.kill(hosted.fuser.pid, signal.SIGCONT)
    assert default(drained(gateway)).fuser_restarts == 0
    assert hosted.fuser.problem == ""


def test_time_in_which_the_server_stood_still_counts_for_nobody(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suspended machine or a paused container stops gateway and fuser alike."""
    gateway = start(fusing("if message.index == 2: time.sleep(0.5)"), fuser_timeout=30.0)
    stepped(gateway, lambda: default(gateway).keyframes_fused == 2)
    real = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: real() + 3600.0)
    assert default(drained(gateway)).fuser_restarts == 0


def test_a_death_between_keyframes_is_nobodys_fault(start: Start, tmp_path: Path) -> None:
    died = tmp_path / "died"
    body = f"""{fusing("pass")}
        if message.index == 2 and not os.path.exists({str(died)!r}):
            open({str(died)!r}, "w").close()
            sys.exit(3)
"""
    gateway = drained(start(body))
    assert default(gateway).rejected == {}


def test_a_fuser_that_hangs_at_a_keyframe_is_replaced(start: Start) -> None:
    hangs = fusing("if message.index == 1: time.sleep(3600)")
    health = default(drained(start(hangs, processes=True, fuser_timeout=0.3)))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


def test_a_fuser_that_does_not_die_yet_holds_nobody_up(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed process that waits for a disk ends when the disk answers: no other may begin before that."""
    killed: list[subprocess.Popen[bytes]] = []
    hangs = fusing("if message.index == 1: time.sleep(3600)")
    gateway = start(hangs, processes=True, fuser_timeout=0.3)
    (hosted,) = gateway.maps
    with monkeypatch.context() as patched:
        patched.setattr(subprocess.Popen, "kill", lambda process: killed.extend([process]))
        longest = 0.0
        while not killed:
            began = time.monotonic()
            gateway.step()
            longest = max(longest, time.monotonic() - began)
        gateway.step()
        fuser = killed[0]
        assert (fuser.pid, fuser.poll(), default(gateway).fuser_restarts) == (hosted.fuser.pid, None, 0)
    fuser.kill()
    assert longest < 3.0  # a step waits 0.1 s for messages
    health = default(drained(gateway))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


@pytest.mark.parametrize(
    ("body", "error", "message"),
    [
        ("sys.exit(9)", MapError, "ended with status 9 before it was ready"),
        (
            "say(fuser_messages.Failed('config', 'no such setting')); link.recv()",
            InvalidConfig,
            "no such setting",
        ),
    ],
)
def test_why_a_fuser_cannot_start_is_one_clear_error(
    start: Start, body: str, error: type[Exception], message: str
) -> None:
    gateway = start(body)
    with pytest.raises(error, match=message):
        stepped(gateway, lambda: gateway.maps.warm)


def test_a_fuser_that_does_not_come_back_is_tried_ever_more_rarely(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gateway goes on receiving: what is in the journal is fused when the fuser can be mended."""
    monkeypatch.setattr(fuser_supervisor, "_LONGEST_PAUSE", 0.05)
    gateway = start(_CANNOT_COME_BACK)
    stepped(gateway, lambda: default(gateway).state == "failed")
    assert default(gateway).fuser_restarts >= 2
    assert "its fuser process ended" in default(gateway).problem
    assert not gateway.health().ready
    monkeypatch.setattr(fuser_process, "COMMAND", fuser_running(fusing("pass")))
    drained(gateway)
    assert default(gateway).problem == ""


def test_poison_costs_two_deaths_each(start: Start) -> None:
    health = default(drained(start(fusing("if message.index in (1, 2, 3): sys.exit(7)"))))
    assert (health.fuser_restarts, health.rejected, health.quarantined) == (6, {"crash": 3}, 3)


def test_no_room_for_a_new_fuser_is_waited_out(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    gateway = start(_CRASHES_ON_2, processes=True)
    real = subprocess.Popen

    monkeypatch.setattr(subprocess, "Popen", refuse(errno.EAGAIN))
    stepped(gateway, lambda: "cannot be started" in default(gateway).problem)
    gateway.step()
    monkeypatch.setattr(subprocess, "Popen", real)
    drained(gateway)
    assert default(gateway).problem == ""


def test_a_vanished_temporary_folder_is_waited_for(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    gateway = start(_CRASHES_ON_2)
    stepped(gateway, lambda: gateway.maps.warm)
    (tmp_path / "temporary").rmdir()  # is empty: a running fuser needs nothing in it
    stepped(gateway, lambda: "cannot be started" in default(gateway).problem)
    (tmp_path / "temporary").mkdir()
    drained(gateway)


def test_the_temporary_folder_may_have_a_path_too_long_for_a_socket(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = tmp_path / ("a" * 120)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    gateway = start(_CRASHES_ON_2)
    stepped(gateway, lambda: gateway.maps.warm)
    assert not default(gateway).problem
    assert not list(long.iterdir())


# --- folders and files that are away ---


def journal_folder(state: Path) -> Path:
    return state_folder.map_folder(state, "default") / "journal"


def test_a_journal_that_is_away_is_said_although_no_keyframe_comes_until_it_is_back(
    start: Start, tmp_path: Path
) -> None:
    go = tmp_path / "go"
    wait = f"[time.sleep(0.01) for _ in iter(lambda: os.path.exists({str(go)!r}), True)]"
    gateway = start(_CRASHES_ON_2.replace("sys.exit(7)", f"{wait}; sys.exit(7)"))
    stepped(gateway, lambda: gateway.maps.warm)
    journal_folder(tmp_path).rename(tmp_path / "aside")
    stepped(gateway, lambda: "No such file" in default(gateway).problem)
    go.touch()
    assert not gateway.health().ready
    hosted = gateway.maps.get("default")
    assert hosted is not None
    stepped(gateway, hosted.fuser.ended)
    for _ in range(3):
        gateway.step()
    assert default(gateway).fuser_restarts == 0  # it would begin with an empty map
    assert not journal_folder(tmp_path).exists()
    assert hosted.ended  # a server that is to end does not wait for it
    (tmp_path / "aside").rename(journal_folder(tmp_path))
    stepped(gateway, lambda: not default(gateway).problem)
    assert default(drained(gateway)).keyframes_fused == 4


def test_nothing_is_deleted_from_a_journal_that_is_away(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an empty folder in its place its segments would count as deleted, and nobody would miss them."""
    monkeypatch.setattr("tsfusion.gateway.maps.map_records._DISK_PAUSE", 0.01)
    gateway = drained(start(fusing("pass")))
    (hosted,) = gateway.maps
    journal_folder(tmp_path).rename(tmp_path / "aside")
    journal_folder(tmp_path).mkdir()
    stepped(gateway, lambda: hosted.records.disk.is_away)
    retention = hosted.records.retention
    retention._max_bytes, retention._in_previous = 1, 2
    gateway.step()
    assert hosted.records.journal.first == 1
    journal_folder(tmp_path).rmdir()
    (tmp_path / "aside").rename(journal_folder(tmp_path))
    stepped(gateway, lambda: hosted.records.journal.first == 2)


def test_segments_that_vanish_are_named_and_the_map_is_saved_at_once(start: Start, tmp_path: Path) -> None:
    saved = f"""{fusing("pass")}
    if isinstance(message, fuser_messages.Save):
        open({str(tmp_path / "saved")!r}, "w").close()
"""
    gateway = drained(start(saved))
    segment = journal.segment_path(journal_folder(tmp_path), 1)
    other = Journal(tmp_path / "other", 1 << 20)
    other.append([b"head"], session=bytes(16), seq=1)
    other.close()
    journal.segment_path(tmp_path / "other", 1).rename(journal.segment_path(journal_folder(tmp_path), 9))
    segment.rename(tmp_path / "aside")
    stepped(gateway, (tmp_path / "saved").exists)
    (problem,) = gateway.health().problems
    assert "map default: 1 segment of its journal is gone, first 000001.mcap" in problem
    (tmp_path / "aside").rename(segment)
    stepped(gateway, lambda: not gateway.health().problems)


@pytest.mark.parametrize("call", ["listdir", "fsync", "stat"])
def test_a_disk_that_fails_while_a_map_is_opened_for_a_client_is_said(
    start: Start, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    gateway = start(fusing("pass"))
    stepped(gateway, lambda: gateway.maps.warm)
    gateway.maps.end_start(("", ""))
    with monkeypatch.context() as patched:
        patched.setattr(os, call, refuse(errno.EIO))
        assert gateway.maps.open_for_client("yard") is None
        assert "error" in gateway.maps.why_not("yard")
        with suppress(JournalError):  # no name is guessed
            assert gateway.maps.free_name("yard") != "yard"
    monkeypatch.setattr("tsfusion.gateway.maps.map_registry._RETRY_INTERVAL", 0.0)
    assert gateway.maps.open_for_client("yard") is not None


def test_a_gap_in_the_journal_is_said_from_the_start(start: Start, tmp_path: Path) -> None:
    begin = Journal(journal_folder(tmp_path), 1)
    for seq in range(10, 13):
        begin.append([b"head"], session=bytes(16), seq=seq)
    journal.segment_path(journal_folder(tmp_path), 2).unlink()
    gateway = start(fusing("pass"))
    stepped(gateway, lambda: gateway.maps.warm)
    assert "map default: 1 segment of its journal was not there at the start" in gateway.health().problems[0]


def test_a_checkpoint_that_cannot_be_written_is_a_problem_and_tried_again(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tsfusion.gateway.maps.map_journal._SAVE_PAUSE", 0.0)
    gateway = start(f"""{fusing("pass")}
        say(fuser_messages.Saved(False, "No space left on device"))
    if isinstance(message, fuser_messages.Save):
        say(fuser_messages.Saved(True))
""")
    seen: list[str] = []

    def is_saved() -> bool:
        seen.extend(gateway.health().problems)
        return default(gateway).checkpoints > 0 and not gateway.health().problems

    stepped(gateway, is_saved)
    assert any(
        one.startswith("map default: no checkpoint can be written: No space left on device") for one in seen
    )


def test_a_record_that_waits_for_its_folder_is_a_problem(start: Start) -> None:
    gateway = start(fusing("say(fuser_messages.Stuck('cannot read it')); time.sleep(0.3)"))
    stepped(gateway, lambda: default(gateway).problem == "cannot read it")
    assert default(drained(gateway)).problem == ""


def test_a_journal_that_ends_before_its_checkpoint_is_said(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    ready = "fuser_messages.Ready({bytes(16): fuser_messages.SessionProgress(9, '')})"
    gateway = start(fusing("pass").replace("fuser_messages.Ready({})", ready))
    stepped(gateway, lambda: gateway.maps.warm)
    assert "its checkpoint holds keyframes of 1 session that its journal" in caplog.text
    assert gateway.maps.progress("default", bytes(16)) == (9, 9)  # they are not taken once more


def test_checkpoints_that_are_lost_with_what_only_they_held_are_said(start: Start, tmp_path: Path) -> None:
    begin = Journal(journal_folder(tmp_path), 1)
    for seq in (8, 9):
        begin.append([b"head"], session=bytes(16), seq=seq)
    journal.segment_path(journal_folder(tmp_path), 1).unlink()
    begin.close()
    gateway = start(fusing("pass"))
    stepped(gateway, lambda: gateway.maps.warm)
    (problem,) = gateway.health().problems
    assert "its checkpoints are lost, and with them what was journaled before segment 2" in problem


def test_the_last_words_of_a_dead_fuser_are_not_heard(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ may deliver them late, when its keyframes are handed out anew."""
    ended: list[FuserProcess] = []
    remove = FuserProcess.remove_socket_file
    monkeypatch.setattr(FuserProcess, "remove_socket_file", lambda one: ended.append(one))  # noqa: PLW0108
    gateway = start(_CANNOT_COME_BACK)
    (hosted,) = gateway.maps
    stepped(gateway, lambda: hosted.fuser._restart_at > time.monotonic() + 0.5)
    late = zmq.Context.instance().socket(zmq.PAIR)
    try:
        endpoint = hosted.fuser.socket.getsockopt_string(zmq.LAST_ENDPOINT)
        late.connect(endpoint)
        late.send(fuser_messages.encode(fuser_messages.Done(0, 1, 2)))
        until(lambda: hosted.fuser.socket.poll(10) > 0)
        assert hosted.fuser.receive() is None
        gateway.step()
    finally:
        late.close(linger=0)
        monkeypatch.setattr(FuserProcess, "remove_socket_file", remove)
        for one in ended:
            remove(one)


_DIES_MOVING = """
    if isinstance(message, fuser_messages.Begin):
        waiting = 3 if message.moves else 0
        moves = fuser_messages.CorrectionProgress(0, 0, waiting, 3 - waiting, 0, 0.0)
        say(fuser_messages.Ready({}, moves=moves))
    if isinstance(message, fuser_messages.Fuse):
        say(fuser_messages.Done(message.index, 1, 2))
        if begin.moves and message.index == 4:
            at(fuser_messages.MOVING)
            sys.exit(7)
"""


def test_corrections_that_kill_the_fuser_twice_are_given_up(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    health = default(drained(start(_DIES_MOVING)))
    assert (health.fuser_restarts, health.keyframes_fused, health.rejected) == (2, 5, {})
    assert (health.corrections_waiting, health.corrections_unavailable) == (0, 3)
    assert "they stay where they were fused until the server starts anew" in caplog.text


def test_an_answer_is_of_the_moment_at_which_it_was_given(start: Start, tmp_path: Path) -> None:
    """A map that is idle now was not, when its fuser answered before it fused the last keyframe."""
    go, said = tmp_path / "go", tmp_path / "said"
    wait = f"while not os.path.exists({str(go)!r}): time.sleep(0.001)"
    answer = f"""if message.index == 4:
                {wait}
                say(fuser_messages.FuserAnswer(7))"""
    end = f"""    if isinstance(message, fuser_messages.Fuse) and message.index == 4:
        open({str(said)!r}, "w").close()
"""
    gateway = start(fusing(answer) + end)
    stepped(gateway, lambda: default(gateway).keyframes_fused == 4)
    (hosted,) = gateway.maps
    go.touch()
    until(said.exists)
    until(lambda: hosted.fuser.socket.poll(10) > 0)
    passed: list[tuple[type, bool]] = []
    hosted.step(lambda message, _frames: passed.append((type(message), hosted.drained)))
    assert passed == [(fuser_messages.FuserAnswer, False)]
    stepped(gateway, lambda: hosted.drained)


def test_orders_that_find_no_room_are_given_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go = tmp_path / "go"  # it reads nothing before
    monkeypatch.setattr(fuser_process, "COMMAND", fuser_running(_SLOW.replace("GO", repr(str(go)))))
    context: zmq.Context[Any] = zmq.Context()
    server = ServerConfig(state=str(tmp_path))
    link = fuser_supervisor.FuserSupervisor(context, tmp_path, server, VolumeConfig())
    try:

        def heard() -> bool:
            link.receive()
            return link.ready

        until(heard)
        refused = 0
        while refused < 20:  # libzmq's thread passes on a few more to the system
            refused = 0 if link.send(fuser_messages.Expire(1)) else refused + 1
            link.socket.poll(5 * bool(refused))
        order = fuser_messages.Fuse(0, Position(1, 8), bytes(16), 1)
        assert not link.fuse(order)
        assert list(link.in_flight) == []
        go.touch()
        until(lambda: link.fuse(order))
        assert list(link.in_flight) == [0]
        link.finish()
        while link.send(fuser_messages.Expire(1)):
            pass
        until(lambda: link.receive() is not None)
        until(lambda: link.ended() or link.finish() is not None)
        assert link.finished_well
    finally:
        link.close()
        context.term()


# --- real scans ---


@pytest.mark.parametrize(
    ("name", "options", "volume"),
    [
        ("7scenes/redkitchen", {}, VolumeConfig(voxel_size=0.04)),
        pytest.param(
            "kitti_odometry",
            {"sequence": "00", "modality": "lidar"},
            VolumeConfig(voxel_size=0.5, sensor="lidar"),
            marks=pytest.mark.nightly,
        ),
    ],
    ids=["7scenes", "kitti-lidar"],
)
def test_a_real_scan_makes_the_same_map_by_file_and_by_socket(
    data: Callable[[str], Path], tmp_path: Path, name: str, options: dict[str, str], volume: VolumeConfig
) -> None:
    dataset = open_dataset(data(name), **options)
    keyframes = [dataset[i] for i in range(0, min(len(dataset), 40), 16)]
    with serving(tmp_path, volume) as server, Client(server.address) as client:
        deliver(client, keyframes)
        assert fetch_status(server.address).map_hash == map_hash(keyframes, volume)
        assert server.terminate() == 0
