# SPDX-License-Identifier: MIT
"""Keyframes as bytes: the wire format of the sockets, the spool and the journal."""

from tsfusion.codec.header import VERSION, Buffer, Header, Refused, stamp, unpack
from tsfusion.codec.message import check, decode, encode

__all__ = ["VERSION", "Buffer", "Header", "Refused", "check", "decode", "encode", "stamp", "unpack"]
