# SPDX-License-Identifier: MIT
"""A control socket that says of a server what a test wants it to say."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import zmq

from tsfusion.wire.messages import messages
from tsfusion.wire.messages.health import Health, Spread, Status
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.sockets import sockets

Answer = Callable[[Command], Reply | bytes | None]


def status(**fields: Any) -> Status:
    """The report of a fuser whose map is well."""
    return Status(**{
        "epoch": "abc", "map": "default", "state": "state/maps/default", "fuser": "idle", "uptime_s": 3.0,
        "keyframes_durable": 6, "keyframes_fused": 5, "keyframes_rejected": {}, "messages_refused": {},
        "duplicates": 0, "sessions": 1, "blocks": 10, "voxels": 100, "map_bytes": 1000, "map_hash": "1f" * 16,
        "color_hash": "2f" * 16, "journal_bytes": 100, "journal_damaged": 0, "fuser_restarts": 0,
        "peak_rss_bytes": {"server": 1, "fuser": 2}, "delay_ms": Spread(), "delay_bound_ms": 0.1,
        "config": {"volume": {"voxel_size": 0.04, "sensor": "kinect"}}, "versions": {}, **fields,
    })  # fmt: skip


def saying(health: Health | Callable[[], Health], *, error: str = "") -> Answer:
    """Answers `health` with this, and `status` with one or with an error."""

    def answer(command: Command) -> Reply | None:
        if command.name == "health":
            return Reply(name="health", health=health if isinstance(health, Health) else health())
        if error:
            return Reply(name=command.name, error=error)
        return Reply(name=command.name, status=status(map=command.map))

    return answer


@contextmanager
def serving(answer: Answer, pings: list[Command] | None = None) -> Iterator[tuple[str, list[Command]]]:
    """The control address of a server that answers so, and what it was asked; None = no answer at all.

    Args:
        pings: takes the pings, which it answers by itself.
    """
    context: zmq.Context[Any] = zmq.Context()
    router = sockets.router(context)
    port = router.bind_to_random_port("tcp://127.0.0.1")
    end = threading.Event()
    asked: list[Command] = []

    def serve() -> None:
        while not end.is_set():
            if router.poll(20):
                identity, frame, *_ = router.recv_multipart()
                command = messages.decode_to_server(frame)
                if isinstance(command, Command) and command.name == "ping":
                    if pings is not None:
                        pings.append(command)
                    pong = Reply(name="ping", version=messages.PROTOCOL_VERSION)
                    router.send_multipart([identity, messages.encode(pong)])
                    continue
                asked.append(command)  # type: ignore[arg-type]
                reply = answer(command)  # type: ignore[arg-type]
                if reply is not None:
                    encoded = reply if isinstance(reply, bytes) else messages.encode(reply)
                    router.send_multipart([identity, encoded])

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}", asked
    finally:
        end.set()
        thread.join()
        router.close()
        context.term()
