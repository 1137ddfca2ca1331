# SPDX-License-Identifier: MIT
"""Texture a mesh with the images that its map was made from: colours as sharp as the cameras saw them.

1. Points are spread over the mesh, and the images are fitted to each other on these points
(`texture_fitting`).
2. The mesh is cut into flat charts, which are laid out on texture pages (`texture_charts`).
3. Every texel is looked up in every image that sees it. Its coarse colour is the mean, by quality; its fine
detail comes from the best views (two bands of Burt and Adelson's blending 1983). Weights change smoothly
over the surface, so there are no seams between views.

Images are read once for the fit and once for each batch of texels; memory holds one image.
"""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.geometry import texture_charts
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.texture_charts import GUARD, ChartPlacement
from tsfusion.geometry.textured_mesh import Texture, TexturedMesh, fields_of
from tsfusion.kernels.answers import texture_baking
from tsfusion.tsdf.texture import texture_fitting
from tsfusion.tsdf.texture.texture_fitting import ImageFit, PosedImages, TextureImage, Visibility, images

_DENSITY = 2500.0  # largest number of points per square metre for the fit; else one per voxel face
_FEWEST, _MOST = 20_000, 2_000_000  # limits of the number of points
_OFF = 2.0  # voxels that a measured depth may deviate from its surface
_BATCH = 4_000_000  # texels looked up per step: about 300 MB
_LAYOUTS = 4  # rounds in which covered faces are moved to free texels
_COARSE = 3.0  # blur in pixels that separates coarse from fine colour
_UNIT = 1e5  # pixels per square metre for a weight of 1
_FINEST = 0.0005  # smallest texel, metres
_GREY = 128

StageProgress = Callable[[str, int, int], None]


class TextureSettings(Struct, frozen=True):
    """Settings of a texture.

    Attributes:
        size: largest side of a texture page, texels; a texture that needs more has several pages.
        texel: metres; None = the median size of a pixel in the best view of each surface point.
        align: fit the poses of the colours to each other.
        even: make the exposures equal.
        sharpness: power of a view's quality; a higher power favours the best views in fine detail.
    """

    size: int = 4096
    texel: float | None = None
    align: bool = True
    even: bool = True
    sharpness: float = 2.0


def textured(
    mesh: Mesh,
    keyframes: PosedImages,
    voxel_size: float,
    settings: TextureSettings | None = None,
    *,
    watch: StageProgress = lambda _stage, _done, _all: None,
) -> TexturedMesh:
    """Give a mesh a texture from keyframes at their poses; surface without an image keeps its own colours.

    The same mesh and keyframes give the same bytes.

    Args:
        keyframes: the map's keyframes; read several times. Keyframes without depth and colour are skipped.
        voxel_size: voxel size of the map, metres.
        watch: called with the stage, the finished steps, and all steps.

    Raises:
        InvalidConfig: for settings out of range.
        MapError: for an empty mesh, or when no keyframe has a colour image that shows the mesh.
        MissingDependency: without xatlas.
    """
    settings = _checked(settings or TextureSettings())
    if not len(mesh.faces):
        raise MapError("there is nothing to texture: the mesh has no triangles (yet)")
    vertices, faces, normals = _arrays(mesh)
    visibility = Visibility(_OFF * voxel_size)
    points, directions = spread(vertices, faces, normals, min(_DENSITY, voxel_size**-2))
    fit = texture_fitting.fit(
        points, directions, keyframes, visibility, align=settings.align, even=settings.even,
        watch=lambda done, total: watch("fitting the images", done, total),
    )  # fmt: skip
    if not fit.images:
        raise MapError(
            "there is nothing to texture with: no keyframe has a colour image (points of a LiDAR have none)"
        )
    if not fit.best.any():
        raise MapError("there is nothing to texture with: no image shows the surface")
    texel = settings.texel or _texel(fit.best)
    layout, owners = _laid_out(mesh, texel, settings.size)
    baker = _Baker(keyframes, fit.images, visibility, settings.sharpness, watch)
    pages, seen = _pages(mesh, layout, owners, baker)
    colors, shown = baker.colors(vertices, normals)
    if mesh.colors is not None:
        colors[~shown] = mesh.colors[~shown]
    sizes = np.array([size[::-1] for size in layout.sizes], np.float32)[layout.page][:, None]
    texture = Texture((layout.corners / sizes).astype(np.float32), layout.page, pages)
    return TexturedMesh(**{**fields_of(mesh), "colors": colors}, texture=texture, seen=seen)


def _checked(settings: TextureSettings) -> TextureSettings:
    if not 256 <= settings.size <= 16384:
        raise InvalidConfig(f"the size of a texture must be from 256 to 16384 texels, got {settings.size}")
    if settings.texel is not None and not _FINEST <= settings.texel <= 1:
        raise InvalidConfig(f"a texel must be from {_FINEST} to 1 m, got {settings.texel}")
    if not 0 < settings.sharpness <= 16:
        raise InvalidConfig(f"sharpness must be above 0 and up to 16, got {settings.sharpness}")
    return settings


def _arrays(mesh: Mesh) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
    return (
        np.ascontiguousarray(mesh.vertices, np.float32),
        np.ascontiguousarray(mesh.faces, np.int32),
        np.ascontiguousarray(mesh.normals, np.float32),
    )


def spread(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], normals: NDArray[np.float32], density: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points evenly spread over a surface, `density` per square metre, and their normals.

    Both are (n, 3) float32. The same surface gets the same points.
    """
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    upto = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    count = int(np.clip(density * upto[-1], _FEWEST, _MOST))
    step = np.arange(count) + 0.5
    face = np.searchsorted(upto, upto[-1] * step / count).clip(max=len(faces) - 1)
    # Barycentric weights from a sequence that fills a unit square evenly (Roberts' R2).
    s, t = (step * 0.7548776662466927) % 1, (step * 0.5698402909980532) % 1
    over = s + t > 1
    s, t = np.where(over, 1 - s, s), np.where(over, 1 - t, t)
    weights = np.stack([1 - s - t, s, t], axis=1)[..., None]
    at, direction = ((weights * array[faces[face]]).sum(axis=1) for array in (vertices, normals))
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    return np.ascontiguousarray(at, np.float32), np.ascontiguousarray(direction, np.float32)


def _texel(best: NDArray[np.float32]) -> float:
    """Return the size of a texel: the median over points of a pixel's size, metres, in the best view."""
    return max(float(1 / np.sqrt(np.median(best[best > 0]))), _FINEST)


def _laid_out(mesh: Mesh, texel: float, size: int) -> tuple[ChartPlacement, list[NDArray[np.int64]]]:
    """Return the triangles' positions on texture pages, and the triangle of each texel: none overlap."""
    vertices, faces, normals = _arrays(mesh)
    charts = texture_charts.find(vertices, faces, normals)
    for attempt in range(_LAYOUTS):
        layout = texture_charts.pack(charts, faces, texel=texel, side=size)
        covered = np.zeros(len(faces), np.uint8)
        owners = []
        for page, shape in enumerate(layout.sizes):
            owner = np.full(shape, texture_baking.NOBODY, np.int64)
            chosen = np.flatnonzero(layout.page == page).astype(np.int32)
            texture_baking.claim_texels(owner, layout.corners, chosen, GUARD - 0.5)
            texture_baking.mark_covered(owner, layout.corners, chosen, covered)
            owners.append(owner)
        if not covered.any() or attempt == _LAYOUTS - 1:
            break
        charts = texture_charts.split(charts, faces, len(vertices), covered.astype(bool))
    return layout, owners


class _Baker:
    """Lookup of colours of surface points in the fitted images."""

    def __init__(
        self,
        keyframes: PosedImages,
        fits: dict[int, ImageFit],
        visibility: Visibility,
        sharpness: float,
        watch: StageProgress,
    ) -> None:
        self._keyframes, self._fits = keyframes, fits
        self._visibility, self._sharpness = visibility, sharpness
        self._watch, self._done, self._all = watch, 0, 0

    def begin(self, calls: int) -> None:
        self._all = calls * len(self._fits)

    def colors(
        self, points: NDArray[np.float32], normals: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return (n, 3) uint8 RGB of surface points (grey: unseen), and a mask of those that images show."""
        sums = np.zeros((len(points), 8), np.float32)
        found = np.empty((len(points), 3), np.float32)
        for image in images(self._keyframes, sorted(self._fits)):
            fit = self._fits[image.number]
            texture_baking.look(
                points, normals, image.T_camera_world, fit.T_camera_world, image.camera, image.depth,
                image.clearness, *self._visibility, found,
            )  # fmt: skip
            texture_baking.blend(found, _strips(image, fit), _UNIT, self._sharpness, sums)
            self._done += 1
            self._watch("painting", self._done, self._all)
        seen = (sums[:, 0] > 0) & (sums[:, 4] > 0)
        rgb = sums[:, 1:4] / np.maximum(sums[:, :1], 1e-30) + sums[:, 5:] / np.maximum(sums[:, 4:5], 1e-30)
        rgb[~seen] = _GREY
        return np.rint(np.clip(rgb, 0, 255)).astype(np.uint8), seen


def _strips(image: TextureImage, fit: ImageFit) -> NDArray[np.float32]:
    """Return (H, W, 7) float32: coarse and fine part of the colours, exposure corrected, and their trust."""
    color = image.color * fit.gain
    coarse = cv2.GaussianBlur(color, (0, 0), _COARSE)
    return np.concatenate([coarse, color - coarse, image.trust[..., None]], axis=2)


def _pages(
    mesh: Mesh, layout: ChartPlacement, owners: list[NDArray[np.int64]], baker: _Baker
) -> tuple[list[NDArray[np.uint8]], float]:
    """Return the texture pages with their colours, and the share of the surface that an image shows."""
    pages, shown, all_inside = [np.full((*shape, 3), _GREY, np.uint8) for shape in layout.sizes], 0, 0
    batches = list(_batches(owners))
    baker.begin(len(batches) + 1)
    vertices, faces, normals = _arrays(mesh)
    for page, texels in batches:
        points, directions = (np.empty((len(texels), 3), np.float32) for _ in range(2))
        owner = owners[page]
        texture_baking.place_texels(
            texels, owner, layout.corners, vertices, normals, faces, points, directions
        )
        colors, seen = baker.colors(points, directions)
        at = texels[:, 0], texels[:, 1]
        if mesh.colors is not None:
            face = (owner[at] & 0xFFFFFFFF)[~seen]
            colors[~seen] = mesh.colors[faces[face]].mean(axis=1).astype(np.uint8)
        pages[page][at] = colors
        inside = owner[at] >> 32 == 0
        shown, all_inside = shown + int((seen & inside).sum()), all_inside + int(inside.sum())
    return pages, shown / max(all_inside, 1)


def _batches(owners: list[NDArray[np.int64]]) -> Iterator[tuple[int, NDArray[np.int32]]]:
    """Yield texels to colour at once: a page's index, with row and column of each, (n, 2) int32."""
    for page, owner in enumerate(owners):
        texels = np.argwhere(owner != texture_baking.NOBODY).astype(np.int32)
        for start in range(0, len(texels), _BATCH):
            yield page, np.ascontiguousarray(texels[start : start + _BATCH])
