# SPDX-License-Identifier: MIT
"""Write what viewers are shown as messages of Foxglove, in its schemas (protobuf, and JSON for plots).

foxglove-sdk encodes them, except for long arrays, which it would take one Python object a point. Two encoded
parts of a protobuf message, one after the other, are that message with the fields of both.
Field numbers: https://github.com/foxglove/foxglove-sdk/tree/main/schemas/proto
"""

from typing import Any

import msgspec
import numpy as np
from foxglove import Schema, messages
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.trajectory import quaternion
from tsfusion.wire.messages.health import Health, headline

WORLD, MAP = "world", "map"  # frames: the map with up along +z, and as it is
_ENTITIES, _LINES, _TRIANGLES = 2, 11, 12  # of a SceneUpdate, and of a SceneEntity
_TRIANGLE_POINTS, _TRIANGLE_COLORS, _TRIANGLE_INDICES = 2, 4, 5
_LINE_POINTS = 5
_WHITE = messages.Color(r=1.0, g=1.0, b=1.0, a=1.0)
_HERE = messages.Pose(
    position=messages.Vector3(x=0.0, y=0.0, z=0.0),
    orientation=messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
)


_FIGURES = {
    "state": "string",
    "problems": "array",
    "keyframes_fused": "integer",
    "waiting_in_server": "integer",
    "waiting_at_scanners": "integer",
    "lost": "integer",
    "delay_p50_ms": "number",
    "delay_p95_ms": "number",
    "delay_max_ms": "number",
    "map_mb": "number",
    "gateway_mb": "number",
    "scanners": "integer",
}
_KINDS = {kind: {"type": kind} for kind in _FIGURES.values()} | {
    "array": {"type": "array", "items": {"type": "string"}}
}
STATE = Schema(
    name="tsfusion.State",
    encoding="jsonschema",
    data=msgspec.json.encode(
        {"type": "object", "properties": {name: _KINDS[kind] for name, kind in _FIGURES.items()}}
    ),
)


def state(health: Health | None, map_name: str, problem: str) -> bytes:
    """Return the state of a map as JSON: its server's health in words, and figures for plots.

    Args:
        problem: reason why the map cannot be seen; the figures are of before.
    """
    if health is None:
        return msgspec.json.encode({"state": problem or "not known yet", "problems": []})
    found = health.maps.get(map_name)
    told = headline(health, only=map_name if found else "")
    words = problem or told.trouble or told.doing, health.problems
    if found is None:  # it is being opened
        return msgspec.json.encode(dict(zip(_FIGURES, words, strict=False)))
    clients = [one for one in health.clients if one.map == map_name]
    delay = found.delay_ms
    spooled = sum(one.waiting for one in clients)
    counts = found.keyframes_fused, found.waiting, spooled, told.lost
    delays = (delay.p50, delay.p95, delay.max) if delay.count else (None, None, None)
    sizes = found.map_bytes / 1e6, health.rss_bytes / 1e6
    connected = sum(one.state == "connected" for one in clients)
    values = *words, *counts, *delays, *sizes, connected
    return msgspec.json.encode(dict(zip(_FIGURES, values, strict=True)))


def triangles(name: str, mesh: Mesh, time_ns: int) -> bytes:
    """Return a SceneUpdate that puts a mesh in the place of the entity `name`, with its colours."""
    assert mesh.colors is not None
    part = messages.TriangleListPrimitive(pose=_HERE, color=_WHITE).encode()
    part += _records(_TRIANGLE_POINTS, mesh.vertices)
    opaque = np.full((len(mesh.colors), 1), 255, np.uint8)
    part += _records(_TRIANGLE_COLORS, np.hstack((mesh.colors, opaque)) / 255)
    part += _field(_TRIANGLE_INDICES, mesh.faces.astype("<u4").tobytes())
    return _scene(name, MAP, time_ns, _field(_TRIANGLES, part))


def lines(
    name: str, frame: str, ends: NDArray[np.float32], color: NDArray[Any], time_ns: int, *, title: str = ""
) -> bytes:
    """Return a SceneUpdate that puts lines in the place of the entity `name`.

    Args:
        ends: (n, 2, 3) ends of each line, metres in `frame`.
        color: (3,) RGB of 0 to 255.
        title: text at the origin of the frame.
    """
    red, green, blue = (float(one) / 255 for one in color)
    part = messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineList,
        pose=_HERE,
        thickness=2.0,
        scale_invariant=True,  # the thickness is in pixels
        color=messages.Color(r=red, g=green, b=blue, a=1.0),
    ).encode()
    text = messages.TextPrimitive(
        pose=_HERE, billboard=True, font_size=14.0, scale_invariant=True, color=_WHITE, text=title
    )
    more = _field(_LINES, part + _records(_LINE_POINTS, ends.reshape(-1, 3)))
    return _scene(name, frame, time_ns, more, texts=[text] if title else [])


def deleted(name: str | None, time_ns: int) -> bytes:
    """Return a SceneUpdate that deletes an entity, or all entities of its topic."""
    kind = messages.SceneEntityDeletionType
    one = messages.SceneEntityDeletion(
        timestamp=_stamp(time_ns), type=kind.All if name is None else kind.MatchingId, id=name or ""
    )
    return messages.SceneUpdate(deletions=[one]).encode()


def transform(parent: str, child: str, T_parent_child: NDArray[np.float64], time_ns: int) -> bytes:
    """Return a FrameTransforms with the (4, 4) pose of one frame in another."""
    x, y, z = T_parent_child[:3, 3].tolist()
    qx, qy, qz, qw = quaternion(T_parent_child[:3, :3]).tolist()
    one = messages.FrameTransform(
        timestamp=_stamp(time_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=messages.Vector3(x=x, y=y, z=z),
        rotation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
    )
    return messages.FrameTransforms(transforms=[one]).encode()


def picture(frame: str, jpeg: bytes, time_ns: int) -> bytes:
    """Return a CompressedImage with a JPEG as it is."""
    found: bytes = messages.CompressedImage(
        timestamp=_stamp(time_ns), frame_id=frame, data=jpeg, format="jpeg"
    ).encode()
    return found


def _scene(name: str, frame: str, time_ns: int, more: bytes = b"", **primitives: Any) -> bytes:
    """Return a SceneUpdate with one entity, whose encoded further fields are `more`."""
    entity = messages.SceneEntity(
        timestamp=_stamp(time_ns), frame_id=frame, id=name, frame_locked=True, **primitives
    )
    return _field(_ENTITIES, entity.encode() + more)


def _stamp(time_ns: int) -> messages.Timestamp:
    return messages.Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)


def _field(number: int, content: bytes) -> bytes:
    """Return a field of bytes (a message, or packed numbers): its tag, its length, and the bytes."""
    rest, size = len(content), bytearray()
    while rest > 0x7F:
        size.append(rest & 0x7F | 0x80)
        rest >>= 7
    return bytes((number << 3 | 2, *size, rest)) + content


def _records(number: int, rows: NDArray[Any]) -> bytes:
    """Return a repeated field of messages, each with the k doubles of one row of (n, k) `rows`."""
    count, width = rows.shape
    parts = [(f"{kind}{i}", kind) for i in range(width) for kind in ("u1", "<f8")]
    found = np.empty(count, [("tag", "u1"), ("size", "u1"), *parts])
    found["tag"], found["size"] = number << 3 | 2, 9 * width
    for i in range(width):
        found[f"u1{i}"], found[f"<f8{i}"] = i + 1 << 3 | 1, rows[:, i]
    return found.tobytes()
