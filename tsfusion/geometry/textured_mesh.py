# SPDX-License-Identifier: MIT
"""Hold meshes with a texture, and write their files."""

import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files, process
from tsfusion.geometry import mesh_encoding
from tsfusion.geometry.mesh import Mesh

TEXTURED = (".glb", ".obj")
_WHITE, _BLACK = np.array([[255] * 4, [0, 0, 0, 255]], np.uint8)


@dataclass(frozen=True, eq=False)
class Texture:
    """Images of a mesh's surface.

    Attributes:
        corners: (m, 3, 2) float32, position of each face's corners in its image: 0 to 1 to the right and down
            (as in glTF).
        page: (m,) int32, the image of each face.
        pages: the images, (H, W, 3) uint8 RGB (sRGB).
    """

    corners: NDArray[np.float32]
    page: NDArray[np.int32]
    pages: list[NDArray[np.uint8]]

    def of_faces(self, kept: NDArray[np.bool_] | NDArray[np.integer]) -> "Texture":
        """Return the texture of some faces, a (m,) bool or numbers, on the same images."""
        return dataclasses.replace(self, corners=self.corners[kept], page=self.page[kept])


@dataclass(frozen=True, eq=False, repr=False)
class TexturedMesh(Mesh):
    """A mesh whose surface shows the images of the cameras.

    Attributes:
        texture: its images. `colors` are their colours at the vertices, for PLY files.
        seen: share of the surface that a camera image shows; the rest has the map's colours.
    """

    texture: Texture = field(kw_only=True)
    seen: float = field(default=1.0, kw_only=True)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write as `Mesh.save` does, GLB and OBJ with the texture.

        A GLB contains its images; an OBJ has `NAME.mtl` and `NAME-0.png` beside it. Other files have the
        colours at the vertices. Raises as `Mesh.save`.
        """
        path = Path(path)
        if path.suffix.lower() not in TEXTURED or not len(self.faces):
            return super().save(path)
        is_glb = path.suffix.lower() == ".glb"
        contents = {path: self.encode(".glb")} if is_glb else self._as_obj(path)
        for place, content in contents.items():
            with durable_files.written(place) as file:
                file.write(content)
        return path

    def encode(self, suffix: str) -> bytes:
        """Encode as `Mesh.encode` does, a `.glb` with the texture."""
        if suffix != ".glb":
            return super().encode(suffix)
        return mesh_encoding.glb_of(self._scene("page"), self)

    def sample(self, face: NDArray[np.integer], weight: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return (n, 3) float32 RGB, 0 to 255, at points on `face` (n,) with barycentric `weight` (n, 3)."""
        found = np.empty((len(face), 3), np.float32)
        at = (np.asarray(weight, np.float32)[..., None] * self.texture.corners[face]).sum(axis=1)
        for number, page in enumerate(self.texture.pages):
            rows = np.flatnonzero(self.texture.page[face] == number)
            height, width = page.shape[:2]
            u, v = at[rows, 0] * width - 0.5, at[rows, 1] * height - 0.5
            i, j = np.floor(u).astype(np.intp), np.floor(v).astype(np.intp)
            s, t = (u - i)[:, None], (v - j)[:, None]
            left, right = np.clip(i, 0, width - 1), np.clip(i + 1, 0, width - 1)
            high, low = np.clip(j, 0, height - 1), np.clip(j + 1, 0, height - 1)
            found[rows] = (1 - t) * ((1 - s) * page[high, left] + s * page[high, right])
            found[rows] += t * ((1 - s) * page[low, left] + s * page[low, right])
        return found

    @property
    def figures(self) -> dict[str, Any]:
        """The figures of `Mesh.figures`, with the texture's sizes and the share of the surface in images."""
        texture = {
            "pages": [list(page.shape[1::-1]) for page in self.texture.pages],
            "seen": round(self.seen, 4),
        }
        return {**super().figures, "texture": texture}

    def of_faces(self, kept: NDArray[np.bool_] | NDArray[np.integer]) -> "TexturedMesh":
        part = super().of_faces(kept)
        return dataclasses.replace(self, **fields_of(part), texture=self.texture.of_faces(kept))

    def page_mesh(self, page: int, *, name: str = "page") -> Any:
        """Return the faces of one image as a `trimesh.Trimesh` with texture; vertices on a seam are doubled.

        `name`: the material's name before the image's number.
        """
        with process.uninterrupted():  # trimesh ignores exceptions while it is imported
            import trimesh
            from PIL import Image

        chosen = self.texture.page == page
        faces, uv = self.faces[chosen].ravel(), self.texture.corners[chosen].reshape(-1, 2)
        rows = np.empty(len(faces), [("vertex", np.int32), ("u", np.float32), ("v", np.float32)])
        rows["vertex"], rows["u"], rows["v"] = faces, uv[:, 0], uv[:, 1]
        found, place = np.unique(rows, return_inverse=True)
        material = trimesh.visual.material.PBRMaterial(
            name=f"{name}-{page}",
            baseColorFactor=_WHITE,  # which readers multiply the picture by
            baseColorTexture=Image.fromarray(self.texture.pages[page]),
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        return trimesh.Trimesh(
            self.vertices[found["vertex"]],
            place.reshape(-1, 3),
            vertex_normals=self.normals[found["vertex"]],
            visual=trimesh.visual.TextureVisuals(
                uv=np.stack([found["u"], 1 - found["v"]], axis=1), material=material
            ),
            process=False,
        )

    def _scene(self, name: str) -> Any:
        import trimesh

        pages = map(int, np.unique(self.texture.page))
        return trimesh.Scene({f"{name}-{page}": self.page_mesh(page, name=name) for page in pages})

    def _as_obj(self, path: Path) -> dict[Path, bytes]:
        from trimesh.exchange.obj import export_obj

        library = path.with_suffix(".mtl").name
        scene = self._scene(path.stem)
        for shape in scene.geometry.values():
            shape.visual.material = shape.visual.material.to_simple()
            shape.visual.material.ambient, shape.visual.material.specular = _WHITE, _BLACK
        text, others = export_obj(scene, include_normals=True, return_texture=True, mtl_name=library)
        return {
            **{path.with_name(name): found for name, found in others.items()},
            path: mesh_encoding.comments(self, b"# ") + text.encode(),
        }


def barycentric(
    ray: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (n, 3) clipped weights where rays from the origin meet triangles (Möller, Trumbore 1997)."""
    across = (np.cross(b, c), np.cross(c, a), np.cross(a, b))
    weight = np.stack([(ray * normal).sum(axis=1) for normal in across], axis=1)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.divide(weight, total, out=np.full_like(weight, 1 / 3), where=total != 0)
    return np.asarray(weight.clip(0, 1))


def fields_of(mesh: Mesh) -> dict[str, Any]:
    """Return the fields of a mesh by name, without those of a texture."""
    return {one.name: getattr(mesh, one.name) for one in dataclasses.fields(Mesh)}
