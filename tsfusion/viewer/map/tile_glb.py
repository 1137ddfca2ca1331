# SPDX-License-Identifier: MIT
"""Encode coloured triangles as GLB for viser's scene: few bytes, and exact colours on the screen.

Positions have 16 bits on a grid that all tiles share, so that neighbours meet without gaps; colours have 16
bits, too. The material is unlit, because a map's colours were lit at capture. three.js applies a film curve
(ACES) to its picture, so the colours are first put through the inverse curve.
"""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

SHARES = 256  # grid steps in a voxel
_MOST = 65535
_BRIGHT = 4.0  # largest white before the curve; more would spread bright colours along an edge
_VERTEX = np.dtype([("position", "<u2", 4), ("color", "<u2", 4)])  # the fourth fills up
_UINT16, _UINT32 = 5123, 5125
# three.js, `ACESFilmicToneMapping`: linear sRGB / 0.6 → _IN → the curve → _OUT
_EXPOSURE = 0.6
_IN = np.array(((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777)))
_OUT = np.array(((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602)))
_BEFORE = (_EXPOSURE * np.linalg.inv(_IN)).T.astype(np.float32)
_AFTER = np.linalg.inv(_OUT).T.astype(np.float32)


def encode(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    colors: NDArray[np.uint8],
    corner: NDArray[np.float64],
    voxel_size: float,
) -> bytes:
    """Return the content of a GLB file.

    Args:
        vertices: (n, 3), metres.
        faces: (m, 3), at least one.
        colors: (n, 3) RGB (sRGB), as shown on the screen.
        corner: (3,) a point of the grid, below all vertices.
        voxel_size: metres; positions are rounded to 1/256 of this, or to twice or four times (…) as much if
            they do not fit.
    """
    step = voxel_size / SHARES
    steps = (vertices - corner) / step
    while steps.max() > _MOST:  # half a step lies on the coarser grid, or between two of its points
        step, steps = 2 * step, steps / 2
    rows = np.zeros(len(vertices), _VERTEX)
    rows["position"][:, :3] = np.clip(np.rint(steps), 0, _MOST)
    rows["color"][:, :3] = np.rint(before_curve(colors) * (_MOST / _BRIGHT))
    indices = faces.astype("<u2" if len(vertices) <= _MOST else "<u4").ravel()
    binary = [rows.tobytes(), indices.tobytes()]
    tree = _tree(rows["position"][:, :3], len(indices), indices.itemsize, corner, step)
    return _packed(tree, b"".join(binary))


def before_curve(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the (n, 3) linear values that three.js shows as these sRGB colours, or as the nearest possible.

    The brightest colours are impossible: white loses 1 % of its light, pure yellow becomes paler.
    """
    y = np.clip(_LINEAR[colors] @ _AFTER, 0.0, 0.999)
    # The curve is (v² + 0.0245786 v − 0.000090537) / (0.983729 v² + 0.432951 v + 0.238081): solved for v
    a, b, c = 1 - 0.983729 * y, 0.0245786 - 0.432951 * y, -0.000090537 - 0.238081 * y
    v = (np.sqrt(b * b - 4 * a * c) - b) / (2 * a)
    found: NDArray[np.float32] = np.clip(v @ _BEFORE, 0.0, _BRIGHT)
    return found


def _tree(
    positions: NDArray[np.uint16], indices: int, width: int, corner: NDArray[np.float64], step: float
) -> dict[str, Any]:
    vertices = len(positions)
    rows = vertices * _VERTEX.itemsize
    material = {
        "pbrMetallicRoughness": {"baseColorFactor": [_BRIGHT, _BRIGHT, _BRIGHT, 1.0]},
        "extensions": {"KHR_materials_unlit": {}},
    }
    common = {"bufferView": 0, "componentType": _UINT16, "count": vertices, "type": "VEC3"}
    low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit", "KHR_mesh_quantization"],
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": corner.tolist(), "scale": [step] * 3}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [material],
        "buffers": [{"byteLength": rows + indices * width}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": rows, "byteStride": _VERTEX.itemsize},
            {"buffer": 0, "byteOffset": rows, "byteLength": indices * width},
        ],
        "accessors": [
            {**common, "byteOffset": 0, "min": low, "max": high},
            {**common, "byteOffset": _VERTEX.fields["color"][1], "normalized": True},  # type: ignore[index]
            {
                "bufferView": 1,
                "componentType": _UINT16 if width == 2 else _UINT32,
                "count": indices,
                "type": "SCALAR",
            },
        ],
    }


def _packed(tree: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(tree, separators=(",", ":")).encode()
    chunks = b""
    for kind, content, filler in ((b"JSON", text, b" "), (b"BIN\0", binary, b"\0"))[: 2 if binary else 1]:
        length = len(content) + -len(content) % 4
        chunks += struct.pack("<I4s", length, kind) + content.ljust(length, filler)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _linear() -> NDArray[np.float32]:
    s = np.arange(256) / 255
    linear: NDArray[np.float32] = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4).astype("f4")
    return linear


_LINEAR = _linear()
EMPTY = _packed({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}, b"")  # of nothing
