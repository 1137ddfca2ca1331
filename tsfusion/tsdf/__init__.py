# SPDX-License-Identifier: MIT
"""The map: integer sums in blocks of 8³ voxels, regularised surface values, meshes, checkpoints."""
