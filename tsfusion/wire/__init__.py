# SPDX-License-Identifier: MIT
"""Messages between scanner, server and viewers: keyframe codec, control messages, sockets and keys.

Rooms:
    asking: a live map asked and followed.
    messages: what client, server and viewers say to one another.
    keys: key files, and who may use which maps.
    records: keyframes, corrections and forgettings as bytes.
    sockets: ZeroMQ sockets, connections and encryption.
"""
