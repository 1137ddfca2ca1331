# SPDX-License-Identifier: MIT
"""The other server process, the only one with Taichi: journal positions in, map and mesh out.

Nothing is imported here: the gateway, which must stay light, imports `tsfusion.fuser.messages`.
"""
