# SPDX-License-Identifier: MIT
"""Carry out whole runs (replay, scan) with their server, write their results, and open saved maps.

Rooms:
    shown: show a saved map in a browser, also at earlier times; a live map on ROS 2.
    runs: scan and replay, the server that they use, and the files that they leave.
    report: write one HTML page on a run or a saved map: pictures, a 3-D view, charts, tables.
    maps: open, ask, merge and align saved maps, and finish their meshes.
"""
