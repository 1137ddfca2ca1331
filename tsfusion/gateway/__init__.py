# SPDX-License-Identifier: MIT
"""The server process that answers: admission, journalling, acknowledgement, one fuser a map.

It never loads Taichi: a kernel holds its process for as long as it takes.

Rooms:
    people: questions and commands to a map, and what its viewers are told.
    migration: a live map on its way to or from another server.
    intake: keyframes and greetings as they come in, and their limits.
    maps: each hosted map, and the folder and settings that it has on disk.
    records: keyframes of a map on their way to its fuser, and what became of them.
    clients: who is connected, with which session, and the way to each.
    fusers: the processes that fuse, one a map.
    ports: sockets, connections, keys, and limits on what strangers may send.
    health: metrics, and problems in words.
"""
