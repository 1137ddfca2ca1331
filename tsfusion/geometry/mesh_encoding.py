# SPDX-License-Identifier: MIT
"""A mesh as the content of a PLY, GLB, OBJ or STL file, and what the file says about itself.

PLY, OBJ and STL keep the map's frame; GLB is turned so that up is +Y, as glTF 2.0 asks for. Guessed triangles
have the face property `guessed` in PLY, are an object of their own in GLB and OBJ, and have 1 as their
attribute in STL.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.provenance import generator
from tsfusion.geometry.up_direction import Up

if TYPE_CHECKING:
    from tsfusion.geometry.mesh import Mesh

_STL_HEADER = 80  # bytes
_STL_FACET = np.dtype([("floats", "<f4", 12), ("attribute", "<u2")])
_PLY_FORMAT = b"format binary_little_endian 1.0\n"


def encode(mesh: "Mesh", suffix: str) -> bytes:
    """The content of a file with this suffix, one of `FORMATS`."""
    return FORMATS[suffix](mesh)


def _ply(mesh: "Mesh") -> bytes:
    shape = mesh.to_trimesh()
    if mesh.guessed is not None:
        shape.face_attributes["guessed"] = mesh.guessed.astype(np.uint8)
    content = bytes(shape.export(file_type="ply", vertex_normal=True))
    head, before, rest = content.partition(_PLY_FORMAT)
    return b"".join((head, before, comments(mesh, b"comment "), rest))


def _obj(mesh: "Mesh") -> bytes:
    shape = mesh.to_trimesh() if mesh.guessed is None else _scene(mesh)
    return comments(mesh, b"# ") + str(shape.export(file_type="obj", include_normals=True)).encode()


def _stl(mesh: "Mesh") -> bytes:
    content = bytes(mesh.to_trimesh().export(file_type="stl"))
    facts = facts_of(mesh)
    head = f"{facts['generator']}, metre, up {facts['up']}, map {facts.get('map_hash', 'unknown')}"
    content = head.encode("ascii", "replace")[:_STL_HEADER].ljust(_STL_HEADER, b"\0") + content[_STL_HEADER:]
    if mesh.guessed is None:
        return content
    facets = np.frombuffer(content, _STL_FACET, offset=_STL_HEADER + 4).copy()
    facets["attribute"] = mesh.guessed
    return content[: _STL_HEADER + 4] + bytes(facets.tobytes())


def _glb(mesh: "Mesh") -> bytes:
    turn = np.eye(3) if mesh.up is None else mesh.up.to_y()
    turned = dataclasses.replace(
        mesh,
        vertices=(mesh.vertices @ turn.T).astype(np.float32),
        normals=(mesh.normals @ turn.T).astype(np.float32),
        colors=None if mesh.colors is None else _SRGB_TO_LINEAR[mesh.colors],
    )
    up = f"map's {described(mesh.up)}" + (", here +y" if mesh.up else "")
    if mesh.guessed is None:
        shape = turned.to_trimesh()
        shape.metadata["up"] = up
    else:
        shape = _scene(turned)
        for one in shape.geometry.values():
            one.metadata["up"] = up
    return bytes(shape.export(file_type="glb", include_normals=True, tree_postprocessor=describing(mesh)))


def describing(mesh: "Mesh") -> Callable[[dict[str, Any]], None]:
    """Function that writes what is known about a mesh into the head of its GLB file."""

    def describe(tree: dict[str, Any]) -> None:
        facts = facts_of(mesh)
        tree["asset"] = {"version": "2.0", "generator": facts.pop("generator"), "extras": facts}

    return describe


def _scene(mesh: "Mesh") -> Any:
    """Seen and guessed triangles as objects of these names."""
    import trimesh

    assert mesh.guessed is not None
    scene = trimesh.Scene()
    for name, which in (("seen", ~mesh.guessed), ("guessed", mesh.guessed)):
        if which.any():
            part = mesh.of_faces(which).to_trimesh()
            part.metadata["name"] = name
            scene.add_geometry(part, geom_name=name, node_name=name)
    return scene


FORMATS: dict[str, Callable[["Mesh"], bytes]] = {".ply": _ply, ".glb": _glb, ".obj": _obj, ".stl": _stl}


def facts_of(mesh: "Mesh") -> dict[str, str]:
    """Notes in a file about its mesh: by name, a line each."""
    facts = {
        "generator": generator(),
        "unit": "metre",
        "frame": "that of the map, right-handed",
        "up": described(mesh.up),
        **(mesh.provenance.facts if mesh.provenance else {}),
    }
    if mesh.guessed is not None:
        facts["guessed"] = (
            f"{int(mesh.guessed.sum())} of {len(mesh.guessed)} triangles, where nothing was seen"
        )
    return facts


def comments(mesh: "Mesh", comment: bytes) -> bytes:
    """Comments with what the file says about itself."""
    lines = [f"{name} {value}".encode() for name, value in facts_of(mesh).items()]
    return b"".join(comment + line + b"\n" for line in lines)


def described(up: Up | None) -> str:
    """A direction in words."""
    return "unknown" if up is None else str(up)


def _srgb_to_linear() -> NDArray[np.uint8]:
    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.round(linear * 255).astype(np.uint8)


_SRGB_TO_LINEAR = _srgb_to_linear()
