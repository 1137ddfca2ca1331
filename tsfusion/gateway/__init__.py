# SPDX-License-Identifier: MIT
"""The server process that answers: admission, journalling, acknowledgement, one fuser a map.

It never loads Taichi: a kernel holds its process for as long as it takes.
"""
