# SPDX-License-Identifier: MIT
"""The fuser process of a map: it gets positions of records in the journal, and makes the map and its mesh.

This file imports nothing: the gateway imports `tsfusion.fuser.fuser_messages`, and must not load Taichi.
"""
