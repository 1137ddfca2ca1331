# SPDX-License-Identifier: MIT
"""Whole runs: replay, scan, the server a run sends to, and what it leaves behind.

Rooms:
    shown: a saved map in a browser, and its past.
    runs: scan, replay, their server, and the files they leave.
    report: a run, or a saved map, as one page: pictures, a 3-D view, charts, tables.
    maps: saved maps opened, asked, merged, aligned, and their meshes.
"""
