# SPDX-License-Identifier: MIT
"""The gateway process of a server: it checks, journals, acknowledges and answers, and starts one fuser a map.

The gateway never loads Taichi: a running kernel blocks its whole process.

Rooms:
    people: questions and commands to a map, and updates for viewers.
    migration: moves of a live map to or from another server.
    intake: checks and limits of incoming keyframes and greetings.
    maps: each hosted map, with its folder and settings on disk.
    records: journaled records that the fuser has yet to answer.
    clients: connected clients, their sessions, and the routes to them.
    fusers: the fuser processes, one for each map.
    ports: sockets, processes and connections, keys, and limits on what strangers send.
    health: metrics, and problems in words.
"""
