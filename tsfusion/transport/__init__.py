# SPDX-License-Identifier: MIT
"""Sockets, control messages and clocks shared by scanner, server and viewers."""

from tsfusion.transport.clock import ClockOffset
from tsfusion.transport.messages import Command, KeyframeTimes, Reply, Status
from tsfusion.transport.request import request
from tsfusion.transport.sockets import Addresses, control_address

__all__ = [
    "Addresses",
    "ClockOffset",
    "Command",
    "KeyframeTimes",
    "Reply",
    "Status",
    "control_address",
    "request",
]
