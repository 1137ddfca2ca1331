# SPDX-License-Identifier: MIT
"""The process of a fuser: its socket, which needs a folder, and its queue, which may be full."""

import errno
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from keyframes_and_servers import until

from tsfusion.core.config import ServerConfig
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.ports import fuser_process
from tsfusion.gateway.ports.fuser_process import FuserProcess

# A fuser that reads nothing before its standard input ends.
_DEAF = """
import os, sys, zmq
from tsfusion.fuser import fuser_messages
from tsfusion.wire.sockets import sockets

link = sockets.pair(zmq.Context())
link.connect(sys.argv[1])
link.send(fuser_messages.encode(fuser_messages.Started()))
while not os.path.exists(sys.argv[4]):
    link.poll(0)
while True:
    if isinstance(fuser_messages.to_fuser.decode(link.recv()), fuser_messages.Finish):
        sys.exit(0)
"""


@pytest.fixture
def context() -> Iterator[Any]:
    made: zmq.Context[Any] = zmq.Context()
    yield made
    made.term()


def test_orders_that_find_no_room_are_not_sent(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = tmp_path / "go"  # it reads nothing before
    monkeypatch.setattr(fuser_process, "COMMAND", (sys.executable, "-c", _DEAF))
    fuser = FuserProcess(context, ServerConfig(), str(go))
    try:
        until(lambda: fuser.receive() is not None)
        refused = 0
        while refused < 20:  # libzmq's thread passes on a few more to the system
            refused = 0 if fuser.send(fuser_messages.Expire(1)) else refused + 1
            fuser.socket.poll(5 * bool(refused))
        go.touch()
        until(lambda: fuser.send(fuser_messages.Finish()))
        until(lambda: fuser.status is not None)
        assert fuser.status == 0
    finally:
        fuser.close()


def test_a_vanished_temporary_folder_is_an_error_that_may_pass(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    with pytest.raises(OSError, match="No such file"):
        FuserProcess(context, ServerConfig(), "yard", waits=True)
    (tmp_path / "temporary").mkdir()
    FuserProcess(context, ServerConfig(), "yard", waits=True).close()


def test_a_socket_that_cannot_be_opened_is_an_error_and_leaves_nothing_behind(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A start is tried again and again."""

    def refuse(_: object) -> None:
        raise zmq.ZMQError(errno.EMFILE)

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(fuser_process.sockets, "pair", refuse)
    with pytest.raises(OSError, match="Too many open files"):
        FuserProcess(context, ServerConfig(), "yard")
    assert not list(tmp_path.iterdir())


def test_the_temporary_folder_may_have_a_path_too_long_for_a_socket(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = tmp_path / ("a" * 120)
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    fuser = FuserProcess(context, ServerConfig(), "yard", waits=True)
    assert not list(long.iterdir())
    fuser.close()


def test_a_killed_process_is_not_waited_for(
    context: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that waits for a disk ends when the disk answers, and is reaped then."""
    monkeypatch.setattr(fuser_process, "COMMAND", (sys.executable, "-c", _DEAF))
    fuser = FuserProcess(context, ServerConfig(), str(tmp_path / "go"))
    process = fuser._process
    assert process is not None
    kill = process.kill
    monkeypatch.setattr(process, "kill", lambda: None)
    monkeypatch.setattr(process, "_try_wait", lambda _: (0, 0), raising=False)
    fuser.close(wait=False)
    monkeypatch.undo()
    assert process.poll() is None
    kill()
    until(lambda: process.poll() is not None)
