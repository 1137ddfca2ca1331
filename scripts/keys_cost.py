# SPDX-License-Identifier: MIT
"""What keys cost a scanner: CPU milliseconds a message, without and with them, over loopback.

    python scripts/keys_cost.py [--bytes 300000] [--messages 300] [--rounds 5]

One JSON line. Sender and receiver are processes of their own, rounds without and with keys take turns;
`client_cpu_ms` is all of the sender's threads, medians over the rounds.
"""

import argparse
import json
import statistics
import subprocess
import sys
import time
from typing import Any

import msgspec
import zmq

from tsfusion.transport import sockets
from tsfusion.transport.curve import ClientKeys, ServerKeys
from tsfusion.transport.zap import Zap


def send(address: str, nbytes: int, count: int, keys: ClientKeys | None) -> dict[str, float]:
    """Send messages as the client does; CPU of this process and time taken, milliseconds a message."""
    context: zmq.Context[Any] = zmq.Context()
    made = sockets.push(context, keys)
    body = bytes(nbytes)
    made.connect(address)
    made.send(b"first")  # connected
    cpu, started = time.process_time(), time.monotonic()
    for _ in range(count):
        made.send_multipart([b"head", body], copy=False)
    made.setsockopt(zmq.LINGER, -1)
    made.close()
    context.term()  # returns when everything has left
    return {
        "cpu_ms": (time.process_time() - cpu) * 1e3 / count,
        "ms": (time.monotonic() - started) * 1e3 / count,
    }


def measure(
    nbytes: int, count: int, server: ServerKeys | None, client: ClientKeys | None
) -> dict[str, float]:
    """One round: receive what a child sends."""
    context: zmq.Context[Any] = zmq.Context()
    zap = Zap(context, lambda _: "anybody")
    made = sockets.pull(context, 1 << 28, server)
    port = made.bind_to_random_port("tcp://127.0.0.1")
    child = subprocess.Popen(
        [sys.executable, __file__, "--send"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdin is not None
    given = (f"tcp://127.0.0.1:{port}", nbytes, count, client and msgspec.structs.asdict(client))
    child.stdin.write(json.dumps(given).encode() + b"\n")
    child.stdin.flush()
    received = 0
    while received <= count:
        for socket, _ in zmq.zmq_poll([(made, zmq.POLLIN), (zap.socket, zmq.POLLIN)], 10_000):
            if socket is made:
                made.recv_multipart(copy=False)
                received += 1
            else:
                zap.answer_all()
    said, _ = child.communicate(timeout=60)
    for one in (made, zap):
        one.close()
    context.term()
    figures: dict[str, float] = json.loads(said)
    return figures


def pair() -> tuple[str, str]:
    """A new public and secret key."""
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def main() -> None:
    if sys.argv[1:2] == ["--send"]:
        address, nbytes, count, keys = json.loads(sys.stdin.readline())
        print(json.dumps(send(address, nbytes, count, ClientKeys(**keys) if keys else None)))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bytes", type=int, default=300_000)
    parser.add_argument("--messages", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=5)
    chosen = parser.parse_args()
    server = ServerKeys(*pair())
    client = ClientKeys(*pair(), server.public)
    rounds: dict[str, list[dict[str, float]]] = {"none": [], "curve": []}
    for _ in range(chosen.rounds):
        rounds["none"].append(measure(chosen.bytes, chosen.messages, None, None))
        rounds["curve"].append(measure(chosen.bytes, chosen.messages, server, client))
    figures: dict[str, Any] = {"bytes": chosen.bytes, "messages": chosen.messages, "rounds": chosen.rounds}
    for name, found in rounds.items():
        figures[name] = {
            "client_cpu_ms": round(statistics.median(one["cpu_ms"] for one in found), 3),
            "ms": round(statistics.median(one["ms"] for one in found), 3),
        }
    figures["cost_cpu_ms"] = round(figures["curve"]["client_cpu_ms"] - figures["none"]["client_cpu_ms"], 3)
    print(json.dumps({**figures, "libzmq": zmq.zmq_version(), "pyzmq": zmq.pyzmq_version()}))


if __name__ == "__main__":
    main()
