# SPDX-License-Identifier: MIT
"""A scene without a browser: remembers what is drawn."""

import json
import struct
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.map import tile_glb

# three.js, `ACESFilmicToneMapping`
_IN = np.array(((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777)))
_OUT = np.array(((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602)))


class Node:
    """A node of the scene, with whatever properties it is given."""

    def __init__(self, scene: "DrawnScene", name: str, fields: dict[str, Any]) -> None:
        self._scene, self.name, self.visible = scene, name, True
        self._impl = SimpleNamespace(props=SimpleNamespace())  # what viser would keep of it
        self.__dict__.update(fields)

    def __setattr__(self, name: str, value: Any) -> None:
        self.__dict__[name] = value
        if name == "glb_data" and value != tile_glb.EMPTY:
            self._scene.bytes_drawn += len(value)

    @property
    def is_empty(self) -> bool:
        return bool(self.__dict__.get("glb_data") == tile_glb.EMPTY)

    def remove(self) -> None:
        assert self._scene.nodes.pop(self.name) is self


@dataclass
class DrawnScene:
    """Takes the place of `viser.SceneApi`.

    Attributes:
        bytes_drawn: of all models that were given to nodes; what is empty does not count.
    """

    nodes: dict[str, Node] = field(default_factory=dict)
    bytes_drawn: int = 0

    def add_glb(self, name: str, glb_data: bytes, **fields: Any) -> Node:
        node = self._add(name, fields)
        node.glb_data = glb_data
        return node

    def add_line_segments(self, name: str, points: Any, colors: Any, **fields: Any) -> Node:
        return self._add(name, {"points": points, "colors": colors, **fields})

    def add_camera_frustum(self, name: str, **fields: Any) -> Node:
        return self._add(name, {"image": None, **fields})

    def add_frame(self, name: str, **fields: Any) -> Node:
        return self._add(name, fields)

    @property
    def models(self) -> list[Any]:
        """Nodes with a model that is not empty."""
        nodes = self.nodes.values()
        return [node for node in nodes if "glb_data" in node.__dict__ and not node.is_empty]

    def shown(self, prefix: str = "") -> set[str]:
        """Names of the nodes that can be seen."""
        found = {name for name, node in self.nodes.items() if node.visible and not node.is_empty}
        return {name for name in found if name.startswith(prefix)}

    def _add(self, name: str, fields: dict[str, Any]) -> Node:
        assert name not in self.nodes, f"{name} is there already"
        self.nodes[name] = Node(self, name, fields)
        return self.nodes[name]


@dataclass
class Model:
    """What a GLB of one object holds: (n, 3) metres, (m, 3), (n, 3) values before tone mapping."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    light: NDArray[np.float64]

    @property
    def colors(self) -> NDArray[np.float64]:
        """(n, 3) sRGB, 0 to 255, as three.js shows them."""
        v = (self.light / 0.6) @ _IN.T
        curve = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
        y = np.clip(curve @ _OUT.T, 0, 1)
        return 255 * np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)


def decoded(content: bytes) -> Model:
    """Read a GLB as a tile has it."""
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size = struct.unpack_from("<I", content, 12)[0]
    tree = json.loads(content[20 : 20 + size])
    binary = content[28 + size :]
    place, color, index = tree["accessors"]
    views = tree["bufferViews"]
    count = place["count"]
    rows = np.frombuffer(binary, "<u2", count * views[0]["byteStride"] // 2).reshape(count, -1)
    kind = {5123: "<u2", 5125: "<u4"}[index["componentType"]]
    faces = np.frombuffer(binary, kind, index["count"], views[1]["byteOffset"])
    node = tree["nodes"][0]
    factor = tree["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][0]
    first = color["byteOffset"] // 2
    assert rows[:, :3].min(axis=0).tolist() == place["min"]
    assert rows[:, :3].max(axis=0).tolist() == place["max"]
    return Model(
        rows[:, :3] * node["scale"][0] + node["translation"],
        faces.reshape(-1, 3).astype(np.int64),
        rows[:, first : first + 3] / 65535 * factor,
    )
