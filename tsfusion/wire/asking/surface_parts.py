# SPDX-License-Identifier: MIT
"""Decoding of what a server sends about cells (mesh updates and answers) into `SurfacePart`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tsfusion.core.errors import DecodeError, TransportError
from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.asking.held_cells import SurfacePart
from tsfusion.wire.asking.queries import mesh_of
from tsfusion.wire.messages.mesh_updates import Meshed

Arrays = dict[str, NDArray[Any]]


def part_of_update(meshed: Meshed, frames: Sequence[Any]) -> SurfacePart:
    """Return the cells and triangles of a mesh update.

    Raises:
        DecodeError: for a malformed update.
    """
    update, layout = meshed.update, meshed.layout
    if update is None or layout is None or not frames:
        raise DecodeError("a mesh update came without its triangles")
    try:
        mesh = mesh_of(layout, [memoryview(frame) for frame in frames[1:]])
    except TransportError as error:
        raise DecodeError(str(error)) from error
    cells = _array(frames[0], np.int32, 3).reshape(-1, 3)
    return _checked(
        SurfacePart(
            cells=cells,
            first_face=_array(update.first_face, np.int32),
            mesh=mesh,
            is_refined=update.refined,
            clients=update.sessions,
            client=_array(update.client, np.int32),
            version=update.version,
            changed=np.full(len(cells), update.version, np.int32),  # at the latest
        )
    )


def part_of_answer(arrays: Arrays, *, is_raw: bool) -> SurfacePart:
    """Return the cells and triangles of an answer.

    Raises:
        DecodeError: for a malformed answer.
    """
    try:
        mesh = Mesh(arrays["vertices"], arrays["faces"], arrays["normals"], arrays.get("colors"))
        found = SurfacePart(
            cells=arrays["cells"],
            first_face=arrays["first_face"],
            mesh=mesh,
            is_refined=bool(arrays["is_refined"]) or not is_raw,
            clients=tuple(one.tobytes() for one in arrays["sessions"]),
            client=arrays["client"],
            version=int(arrays["state"][0]),
            changed=arrays["changed"],
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DecodeError(f"an answer about cells is malformed: {error!r}") from error
    return _checked(found)


def _array(content: Any, dtype: DTypeLike, columns: int = 1) -> NDArray[Any]:
    if memoryview(content).nbytes % (columns * np.dtype(dtype).itemsize):
        raise DecodeError("a mesh update has parts of numbers")
    return np.frombuffer(content, dtype)


def _checked(part: SurfacePart) -> SurfacePart:
    """Return the part. Raise DecodeError unless its arrays fit together."""
    rows, mesh = len(part.cells), part.mesh
    fits = part.cells.shape == (rows, 3) and len(part.first_face) == rows + 1
    fits = fits and len(part.client) == len(part.changed) == rows
    fits = fits and bool((np.diff(part.first_face, prepend=0, append=len(mesh.faces)) >= 0).all())
    fits = fits and part.first_face[0] == 0 and part.first_face[-1] == len(mesh.faces)
    if not fits:
        raise DecodeError(f"what came for {rows} cells does not fit together")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise DecodeError("triangles have corners that did not come")
    if rows and not -1 <= part.client.min() <= part.client.max() < len(part.clients):
        raise DecodeError("cells were seen by sessions that did not come")
    return part
