# SPDX-License-Identifier: MIT
"""Name what DDS and Zenoh have in common: topics of ROS 2, messages as bytes, and their types.

Names follow ROS 2's design articles (rt/…, pkg::msg::dds_::Type_), hashes of types REP 2011.
"""

import os
from collections.abc import Callable
from functools import cache
from typing import Any, Literal, NamedTuple, Protocol

from tsfusion.core.errors import InvalidConfig, MissingDependency
from tsfusion.datasets.rosbag.reader import Stream, usual_types

Transport = Literal["dds", "zenoh"]
TRANSPORTS: tuple[Transport, ...] = ("dds", "zenoh")
INSTALL = "pip install '.[ros2]' in your clone of tsfusion"
_MOST_DOMAIN = 232  # DDS has no ports for a higher one
TRIGGER = "std_srvs/srv/Trigger"
SERVICE_HASHES = {TRIGGER: "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"}
_LOCAL = ("LOCALHOST", "OFF")


class LiveTopic(NamedTuple):
    """Topic that somebody publishes."""

    name: str  # such as /camera/depth/image_raw
    kind: str  # such as sensor_msgs/msg/Image
    transport: Transport
    publishers: int
    reliable: bool  # all its publishers send lost messages again
    latched: bool  # all its publishers keep messages for those who come later ("transient local")

    @property
    def stream(self) -> Stream:
        """The topic in the form of a recording; its messages are not counted."""
        return Stream(self.name, self.kind, 1)


class CdrMessage(NamedTuple):
    """Message as it came."""

    stream: Stream
    publisher: bytes
    log_ns: int  # `time.time_ns()` of its arrival
    captured_ns: int  # `time.monotonic_ns()` of its arrival
    content: bytes  # CDR with its header of 4 bytes


Deliver = Callable[[CdrMessage], None]  # called from a thread of the middleware
Respond = Callable[[bytes], bytes]  # a request's CDR → its response's


class Middleware(Protocol):
    """Topics and messages of one ROS domain over one transport.

    A middleware is opened with a `Deliver`, which gets the messages of all topics subscribed to.
    """

    name: Transport

    def topics(self) -> list[LiveTopic]:
        """Return what is published now by others and by this process."""

    def subscribe(self, topic: LiveTopic) -> None:
        """Have the topic's messages delivered, at the reliability and durability that it offers."""

    def unsubscribe(self, topic: str) -> None:
        """End the delivery of a topic's messages, if it was subscribed to."""

    def announce(self, topic: str, kind: str, *, latched: bool = False) -> None:
        """Tell others that this process publishes a topic; a latched one keeps its last message for them."""

    def listeners(self, topic: str) -> int:
        """Return the number of subscribers of a topic that was announced; those who say nothing are one."""

    def publish(self, topic: str, content: bytes) -> None:
        """Send a message on a topic that was announced."""

    def serve(self, service: str, kind: str, answer: Respond) -> None:
        """Respond the requests of a service of the type `kind`, in a thread of the middleware."""

    def close(self) -> None:
        """End all threads and leave the domain. It may be called twice."""


def dds_type(kind: str) -> str:
    """Return DDS's name of a type: sensor_msgs::msg::dds_::Image_ of sensor_msgs/msg/Image."""
    package, part, name = kind.split("/")
    return f"{package}::{part}::dds_::{name}_"


def ros_type(name: str) -> str | None:
    """Return ROS's name of a DDS type, or None if it is no type of ROS 2."""
    parts = name.split("::")
    is_ros = len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_") and len(parts[3]) > 1
    return "/".join((*parts[:2], parts[3][:-1])) if is_ros else None


@cache
def message_types() -> Any:
    """Return rosbags' store of the usual types. Raises MissingDependency."""
    try:
        from rosbags.interfaces import Nodetype

        store = usual_types(True)
    except ImportError as error:
        raise MissingDependency(f"ROS 2 needs rosbags: {INSTALL}") from error
    flag, text = (Nodetype.BASE, ("bool", 0)), (Nodetype.BASE, ("string", 0))
    store.register({  # which rosbags lacks
        f"{TRIGGER}_Request": ([], []),
        f"{TRIGGER}_Response": ([], [("success", flag), ("message", text)]),
    })  # fmt: skip
    return store


def domain_id(given: int | None) -> int:
    """Return the number of the ROS domain, by default ROS_DOMAIN_ID or 0. Raises InvalidConfig."""
    text = str(given) if given is not None else os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > _MOST_DOMAIN:
        raise InvalidConfig(f"a ROS domain must be 0 to {_MOST_DOMAIN}, got {text!r} (ROS_DOMAIN_ID)")
    return int(text)


def is_local() -> bool:
    """Return True if the environment keeps ROS 2 on this machine."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    return reach in _LOCAL or os.environ.get("ROS_LOCALHOST_ONLY") == "1"
