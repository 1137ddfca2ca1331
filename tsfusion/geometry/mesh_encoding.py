# SPDX-License-Identifier: MIT
"""Encode a mesh as PLY, GLB, OBJ or STL, with facts about the mesh in the file.

Vertices are in the map's frame; the nodes of a GLB turn them so that up is +Y, as glTF 2.0 asks. Guessed
triangles come last in PLY, are a separate object in GLB and OBJ, and have the attribute 1 in STL.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh_arrays import MeshArrays, generator
from tsfusion.geometry.up_direction import Up

_STL_HEADER = 80  # bytes
_STL_FACET = np.dtype([("floats", "<f4", 12), ("attribute", "<u2")])
_PLY_FORMAT = b"format binary_little_endian 1.0\n"
_LINEAR = "_LINEAR"  # trimesh's name for colours of 16 bits, until they are COLOR_0
_OPAQUE = 65535
TURNED_BY_NODE = "turned to +y by the node"  # end of an object's metadata `up`
_MATTE = {"name": "matte", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}


def encode(mesh: MeshArrays, suffix: str) -> bytes:
    """Return a mesh as the content of a file with this suffix, one of `FORMATS`."""
    return FORMATS[suffix](mesh)


def _ply(mesh: MeshArrays) -> bytes:
    if mesh.guessed is not None:  # some readers fail on a face property that is no list
        order = np.argsort(mesh.guessed, kind="stable")
        mesh = dataclasses.replace(mesh, faces=mesh.faces[order], guessed=mesh.guessed[order])
    content = bytes(mesh.to_trimesh().export(file_type="ply", vertex_normal=True))
    head, before, rest = content.partition(_PLY_FORMAT)
    return b"".join((head, before, comments(mesh, b"comment "), rest))


def _obj(mesh: MeshArrays) -> bytes:
    shape = mesh.to_trimesh() if mesh.guessed is None else _scene(mesh)
    return comments(mesh, b"# ") + str(shape.export(file_type="obj", include_normals=True)).encode()


def _stl(mesh: MeshArrays) -> bytes:
    content = bytes(mesh.to_trimesh().export(file_type="stl"))
    facts = facts_of(mesh)
    head = f"{facts['generator']}, metre, up {facts['up']}, map {facts.get('map_hash', 'unknown')}"
    content = head.encode("ascii", "replace")[:_STL_HEADER].ljust(_STL_HEADER, b"\0") + content[_STL_HEADER:]
    if mesh.guessed is None:
        return content
    facets = np.frombuffer(content, _STL_FACET, offset=_STL_HEADER + 4).copy()
    facets["attribute"] = mesh.guessed
    return content[: _STL_HEADER + 4] + bytes(facets.tobytes())


def _glb(mesh: MeshArrays) -> bytes:
    from trimesh.visual import ColorVisuals

    scene = _scene(mesh)
    if mesh.colors is not None:
        for shape in scene.geometry.values():
            linear = _SRGB_TO_LINEAR[shape.visual.vertex_colors[:, :3]]
            shape.visual = ColorVisuals()
            shape.vertex_attributes[_LINEAR] = np.pad(linear, ((0, 0), (0, 1)), constant_values=_OPAQUE)
    return glb_of(scene, mesh)


def glb_of(scene: Any, mesh: MeshArrays) -> bytes:
    """Return a GLB of a mesh's objects, which are in the map's frame.

    Each node turns its object so that up is +Y. Objects without a texture get a non-metallic material.
    """
    if mesh.up is not None:
        turn = np.eye(4)
        turn[:3, :3] = mesh.up.to_y()
        scene.apply_transform(turn)
        for shape in scene.geometry.values():
            shape.metadata["up"] = f"map's {described(mesh.up)}, {TURNED_BY_NODE}"

    def describe(tree: dict[str, Any]) -> None:
        facts = facts_of(mesh)
        if mesh.up is not None:
            facts["frame"] += "; the nodes' matrices turn up to +y"
        tree["asset"] = {"version": "2.0", "generator": facts.pop("generator"), "extras": facts}
        for part in (part for one in tree["meshes"] for part in one["primitives"]):
            if _LINEAR in part["attributes"]:
                part["attributes"]["COLOR_0"] = number = part["attributes"].pop(_LINEAR)
                tree["accessors"][number]["normalized"] = True
            if "material" not in part:
                tree["materials"], part["material"] = [_MATTE], 0

    return bytes(scene.export(file_type="glb", include_normals=True, tree_postprocessor=describe))


def _scene(mesh: MeshArrays) -> Any:
    """Return a trimesh scene: the objects `seen` and `guessed`, or one object `mesh` without guesses."""
    import trimesh

    scene = trimesh.Scene()
    if mesh.guessed is None:
        scene.add_geometry(mesh.to_trimesh(), geom_name="mesh", node_name="mesh")
        return scene
    for name, which in (("seen", ~mesh.guessed), ("guessed", mesh.guessed)):
        if which.any():
            part = mesh.of_faces(which).to_trimesh()
            part.metadata["name"] = name
            scene.add_geometry(part, geom_name=name, node_name=name)
    return scene


FORMATS: dict[str, Callable[[MeshArrays], bytes]] = {".ply": _ply, ".glb": _glb, ".obj": _obj, ".stl": _stl}


def facts_of(mesh: MeshArrays) -> dict[str, str]:
    """Return the facts that a file states about its mesh: by name, one line each."""
    facts = {
        "generator": generator(),
        "unit": "metre",
        "frame": "that of the map, right-handed",
        "up": described(mesh.up),
        **(mesh.provenance.facts if mesh.provenance else {}),
    }
    if mesh.guessed is not None:
        count = f"{int(mesh.guessed.sum())} of {len(mesh.guessed)} triangles"
        facts["guessed"] = f"{count}, the last of a PLY, where nothing was seen"
    return facts


def comments(mesh: MeshArrays, comment: bytes) -> bytes:
    """Return comment lines of a file with the facts about a mesh. `comment`: bytes that begin such a line."""
    lines = [f"{name} {value}".encode() for name, value in facts_of(mesh).items()]
    return b"".join(comment + line + b"\n" for line in lines)


def described(up: Up | None) -> str:
    """Return an up direction as text."""
    return "unknown" if up is None else str(up)


def _srgb_to_linear() -> NDArray[np.uint16]:
    """Return the linear light of each sRGB level, 0 to 65535; in 8 bits most dark levels would coincide."""
    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.round(linear * _OPAQUE).astype(np.uint16)


_SRGB_TO_LINEAR = _srgb_to_linear()
