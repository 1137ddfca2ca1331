# SPDX-License-Identifier: MIT
"""Sockets, control messages and clocks shared by scanner, server and viewers."""

from tsfusion.transport.clock import ClockOffset
from tsfusion.transport.curve import ClientKeys, client_keys
from tsfusion.transport.messages import Command, KeyframeTimes, Reply, Status
from tsfusion.transport.request import request
from tsfusion.transport.sockets import Addresses, control_address

__all__ = [
    "Addresses",
    "ClientKeys",
    "ClockOffset",
    "Command",
    "KeyframeTimes",
    "Reply",
    "Status",
    "client_keys",
    "control_address",
    "request",
]
