# SPDX-License-Identifier: MIT
"""Shading against its NumPy twin."""

import kernel_twins
import numpy as np

from tsfusion.kernels.answers import rasterizer
from tsfusion.kernels.base import runtime


def test_shading_equals_the_twin() -> None:
    runtime.start(2)
    random = np.random.default_rng(31)
    centres = random.uniform((-2, -1.5, 2), (2, 1.5, 6), (40, 1, 3))
    vertices = (centres + random.normal(0, 0.6, (40, 3, 3))).reshape(-1, 3).astype(np.float32)
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.5)
    normals = random.normal(size=vertices.shape)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colors = random.integers(0, 256, vertices.shape).astype(np.uint8)
    faces = np.arange(120, dtype=np.int32).reshape(-1, 3)
    focal, up = 50.0, np.array([0.0, -0.8, -0.6])
    seen = np.full((48, 64), rasterizer.EMPTY, np.int64)
    image = np.zeros((48, 64, 4), np.float32)
    rasterizer.rasterise(seen, vertices, faces, focal, 0.05)
    rasterizer.shade(image, seen, vertices, faces, normals, colors, focal, *up, rasterizer.EMPTY)
    pixels = np.argwhere(seen != rasterizer.EMPTY)
    assert len(pixels) > 500
    for v, u in pixels[::7]:
        corner = faces[seen[v, u] & 0xFFFFFFFF]
        ray = np.array([(u - 31.5) / focal, (v - 23.5) / focal, 1.0])
        expected = kernel_twins.shade(vertices[corner], normals[corner], colors[corner], ray, up)
        assert np.allclose(image[v, u, :3], expected, atol=2e-3)
