# SPDX-License-Identifier: MIT
"""Whole runs: replay, scan, the server a run sends to, and what it leaves behind."""
