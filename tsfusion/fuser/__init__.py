# SPDX-License-Identifier: MIT
"""Fuse a map in a process of its own: journal positions come in, map and mesh go out.

This file imports nothing: the gateway imports `tsfusion.fuser.fuser_messages`, and must not load Taichi.
"""
