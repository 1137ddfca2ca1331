# SPDX-License-Identifier: MIT
"""The map: integer sums in blocks of 8³ voxels, regularised surface values, meshes, checkpoints.

Rooms:
    device: the map on a GPU, in a process of its own.
    files: saved maps, read, written and added.
    texture: images laid over a mesh.
    answers: samples, views, slices and distances of a map.
    sums: maps added, cropped and compared.
    surface: the regularised field, and meshes of it.
    integration: rays of a keyframe, and their votes.
    store: blocks in memory or in a file, and what is counted of each.
"""
