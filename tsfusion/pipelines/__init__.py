# SPDX-License-Identifier: MIT
"""Whole runs: replay, scan, the server a run sends to, and what it leaves behind.

Rooms:
    report: a run, or a saved map, as one page: pictures, a 3-D view, charts, tables.
"""
