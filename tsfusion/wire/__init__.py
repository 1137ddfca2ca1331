# SPDX-License-Identifier: MIT
"""Messages between scanner, server and viewers, and the sockets and keys that carry them.

Rooms:
    asking: questions to a live map, and programs that follow it.
    messages: structs that client, server and viewers send to one another.
    keys: key files, and the list of maps that each key may use.
    records: keyframes, corrections and forgettings as bytes.
    sockets: ZeroMQ sockets, connections and encryption.
"""
