# SPDX-License-Identifier: MIT
"""The other server process, the only one with Taichi: journal positions in, map and mesh out.

This file imports nothing: the gateway imports `tsfusion.fuser.fuser_messages`, and must stay without Taichi.
"""
