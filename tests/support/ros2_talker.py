# SPDX-License-Identifier: MIT
"""A process that plays a ROS 2 bag over DDS or Zenoh, and the environment in which it stays on this machine.

Run: ros2_talker.py BAG TRANSPORT DOMAIN ROUTER HZ [FIRST [LAST]]. It waits until somebody reads the images,
plays so many messages of depth with all that lies between, says `played`, and stays until its input ends.
"""

import os
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

TIMED = "sensor_msgs/msg/Image"
UNHEARD = "sensor_msgs/msg/CameraInfo"  # only one of two is subscribed to, once topics are chosen


def libraries(transport: str) -> None:
    """Skip where the transport's library is not installed."""
    pytest.importorskip("rosbags", reason="extra ros2")
    pytest.importorskip({"dds": "cyclonedds", "zenoh": "zenoh"}[transport], reason="extra ros2")


def on_this_machine(monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Keep DDS and Zenoh on this machine; return a random domain, and where its Zenoh router would listen."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    for name in ("CYCLONEDDS_URI", "ROS_DOMAIN_ID", "ZENOH_SESSION_CONFIG_URI"):
        monkeypatch.delenv(name, raising=False)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return random.SystemRandom().randrange(20, 200), f"tcp/127.0.0.1:{port}"


@contextmanager
def talker(*words: object) -> Iterator["subprocess.Popen[str]"]:
    """A process of this file; its end is awaited."""
    made = subprocess.Popen(
        [sys.executable, __file__, *map(str, words)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        yield made
    finally:
        made.kill()
        made.communicate()


def listener(router: str) -> object:
    """A Zenoh session that listens where a router would."""
    import json

    import zenoh

    config = zenoh.Config()
    for key, value in (
        ("mode", "router"),
        ("listen/endpoints", [router]),
        ("scouting/multicast/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def main(bag: Path, transport: str, domain: int, router: str, rate: float, first: int, last: int) -> None:
    from rosbags.highlevel import AnyReader

    from tsfusion.datasets.ros2.live_messages import open_middlewares

    (own,) = open_middlewares(lambda _: None, transport=transport, domain=domain, router=router)
    with AnyReader([bag]) as reader:
        held = [(one.topic, one.msgtype, bytes(raw)) for one, _, raw in reader.messages()]
    timed = [i for i, (topic, kind, _) in enumerate(held) if kind == TIMED and "depth" in topic]
    begins = [0, *timed[1:], len(held)]
    for topic, kind in {(topic, kind) for topic, kind, _ in held}:
        own.announce(topic, kind, latched=topic == "/tf_static")
    while not all(own.listeners(topic) for topic, kind, _ in held if kind != UNHEARD):
        time.sleep(0.01)
    due = time.monotonic()
    for number in range(first, min(last, len(timed))):
        for topic, _, raw in held[begins[number] : begins[number + 1]]:
            own.publish(topic, raw)
        due += 1 / rate
        time.sleep(max(0.0, due - time.monotonic()))
    print("played", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    first, last = [*map(int, sys.argv[6:]), *(0, 1 << 30)[len(sys.argv) - 6 :]]
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), sys.argv[4], float(sys.argv[5]), first, last)
    os._exit(0)
