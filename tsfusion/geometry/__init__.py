# SPDX-License-Identifier: MIT
"""Model keyframes, frames, cameras, rigid transforms, trajectories and meshes, with NumPy and OpenCV only."""
