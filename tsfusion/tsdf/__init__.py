# SPDX-License-Identifier: MIT
"""The map: integer sums in blocks of 8³ voxels, with the surfaces, meshes and files made from them.

Rooms:
    device: keeps a map's blocks on a GPU, in a separate process.
    files: reads, writes and adds saved maps.
    texture: projects camera images onto a mesh.
    answers: computes samples, views, slices and distances of a map.
    sums: adds, crops and compares maps.
    surface: smooths the surface (the field) and meshes the result.
    integration: turns a keyframe into rays, and adds their votes to the map.
    store: keeps blocks in memory or in a file, with counts for each block.
"""
