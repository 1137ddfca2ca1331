# SPDX-License-Identifier: MIT
"""Keyframes, frames, cameras, rigid transforms, trajectories and meshes. NumPy and OpenCV, no Taichi."""
