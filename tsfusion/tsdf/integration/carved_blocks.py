# SPDX-License-Identifier: MIT
"""Find the free space that the current keyframe looks through, on the CPU.

A map that carves gets the blocks and voxels that an image carves. Another map gets only whole blocks that an
image or points look through.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.kernels.base.sensor_noise import MAX_CARVED, MAX_RANGE, VOXEL_SIZE
from tsfusion.kernels.base.voxel_traversal import VOXEL_LIMIT
from tsfusion.kernels.integration import space_carving
from tsfusion.kernels.integration.space_carving import (
    BLOCKS,
    FINEST,
    NEAREST,
    NO_SAMPLE,
    PATCH,
    SCALE,
    SIDE,
    VIEW_TANGENT,
    VIEWS,
    VOXELS,
    WORDS,
)

_FEW = 1024  # blocks in the list at first
_MOST_UNITS = 1 << 30  # largest image coordinate
_COARSEST = 64  # smallest number of units per voxel
_MOST_CUBES = VOXEL_LIMIT // SIDE - 1  # cubes from the map's origin, in each direction
_FARTHEST = VOXEL_LIMIT - SIDE  # voxels from a camera to the map's origin
_LEAST_CUBE = 0.12  # metres; with fine voxels, no smaller cubes are looked for
_THINNEST = 4  # largest step between the pixels that are read, and between their rows
_THIN_VOXELS = 2.0  # largest width of such a pixel
_POINTS = 1 << 14  # points that are drawn, about
_PATCHES = 80  # patches per side of an image of points
_GAP = 8.0  # voxels (a block); wider gaps between points count as not looked through
_GAPS = 3  # patches; empty patches nearer than this to a point are filled
_MOST_STANDS = 4  # largest number of viewpoints for one sweep
_STAND = 2.0  # voxels that a ray's start may lie away from its viewpoint

# Image, disparity flag, scale, confidence, confidence flag: arguments of the kernels
Read = tuple[NDArray[np.float32], int, float, NDArray[Any], int]
Optics = tuple[NDArray[np.float64], ...]


class PointRays(NamedTuple):
    """Points (n, 3), starts of their rays, (1, 3) or (n, 3), in the sensor's frame; optional confidence."""

    points: NDArray[np.float32]
    starts: NDArray[np.float32]
    confidence: NDArray[Any]
    has_confidence: int


class _Sight(NamedTuple):
    """View of a camera or of points, in the form that kernels read (`space_carving`). `rays`, (3, 4), go
    through the image's corners at depth one."""

    numbers: NDArray[np.float64]
    rays: NDArray[np.float64]


class CarvedBlocks:
    """Blocks that a keyframe carves: their keys, their clear voxels, and the amount added to each voxel.

    Attributes:
        clear: distinct keys of blocks that are completely clear, for a map that does not carve.
    """

    def __init__(self) -> None:
        self.voxels = 0  # number of clear voxels
        self.keys = np.empty(0, np.int64)
        self.amounts = np.empty(0, np.int64)
        self.masks = np.empty((0, WORDS), np.int64)
        self.clear = np.empty(0, np.int64)
        self._room = _list_of(0)
        self._counts = np.zeros(2, np.int32)
        self._kind: tuple[object, ...] = ()  # properties of the camera in `_found`
        self._found: Optics = ()
        self._image, self._points = _PatchImages(), _PatchImages()

    def __len__(self) -> int:
        return len(self.keys)

    def forget(self) -> None:
        """Remove all blocks, for a keyframe that carves nothing."""
        self.voxels = 0
        self.keys, self.amounts, self.masks = (array[:0] for array in self._room)
        self.clear = self.clear[:0]

    def find(self, keyframe: Keyframe, read: Read, model: NDArray[np.float64], most: int) -> None:
        """Find the blocks that a keyframe's image carves.

        Args:
            keyframe: a keyframe with an image.
            read: its image as the kernels read it.
            model: the sensor model, as for `rays_from_images`.
            most: blocks that a keyframe may touch; a longer list is cut at one block more.
        """
        assert keyframe.intrinsics is not None  # checked by Keyframe
        self.forget()
        view = self._see(keyframe.intrinsics, keyframe.T_world_camera, read, model)
        if view is None:
            return
        image, cubes = self._image, _cubes_in([view], self._image)[0, 1:]
        if not len(self._room[0]):
            self._room = _list_of(_FEW)
        while True:
            self._counts[:] = 0
            space_carving.list_free_blocks(
                image.clear, *image.pixels, image.levels, image.least, image.most, view.numbers, model, cubes,
                *self._room, self._counts,
            )  # fmt: skip
            count, room = int(self._counts[BLOCKS]), len(self._room[0])
            if count <= room or room > most:
                break
            self._room = _list_of(min(4 * room, most + 1))
        self.keys, self.amounts, self.masks = (array[:count] for array in self._room)
        self.voxels = int(self._counts[VOXELS])

    def find_clear(self, keyframe: Keyframe, read: Read, model: NDArray[np.float64], most: int) -> None:
        """Find the blocks that an image looks through completely, or none if there are more than `most`.
        Arguments are those of `find`."""
        assert keyframe.intrinsics is not None
        self.forget()
        K, read = _thinned(keyframe.intrinsics, read, model)
        if 0 in read[0].shape:
            return
        view = self._see(K, keyframe.T_world_camera, read, model)
        if view is not None:
            self.clear = self._listed([view], self._image, model[VOXEL_SIZE], most)

    def find_clear_of_points(
        self, points: PointRays, T_world_sensor: NDArray[np.float64], model: NDArray[np.float64], most: int
    ) -> None:
        """Find the blocks that points' rays pass through completely, by images around their viewpoints."""
        self.forget()
        found = [self.clear]
        for part, centre in _stands(points, model[VOXEL_SIZE]):
            found.append(self._seen_from(centre, part, T_world_sensor, model, most))
        clear = distinct(np.concatenate(found))
        self.clear = clear[: len(clear) if len(clear) <= most else 0]

    def _seen_from(
        self,
        centre: NDArray[np.float32],
        points: PointRays,
        T_world_sensor: NDArray[np.float64],
        model: NDArray[np.float64],
        most: int,
    ) -> NDArray[np.int64]:
        """Return the keys of the blocks that points look through completely, by images around a centre."""
        images, side, T = self._points, _PATCHES * PATCH, T_world_sensor
        images.make_room(side, side)
        focal, middle = side / (2 * VIEW_TANGENT), (side - 1) / 2
        camera = self._camera(Intrinsics(focal, focal, middle, middle), (side, side), model)
        where = T[:3] @ np.append(centre.astype(np.float64), 1.0)
        far, scale = camera[2][:2]
        if far <= NEAREST or np.abs(where).max() > _FARTHEST * model[VOXEL_SIZE]:
            return self.clear
        ends, seen = np.full((VIEWS * _PATCHES, _PATCHES), NO_SAMPLE, np.int32), np.zeros(VIEWS, np.int32)
        step = -(-len(points.points) // _POINTS)
        space_carving.see_points(*points, step, centre, model, scale, ends, seen)
        used = np.flatnonzero(seen)
        if not len(used):
            return self.clear
        images.use(_closed(ends.reshape(VIEWS, _PATCHES, _PATCHES)[used], scale, far))
        views = [_view(camera, where, T[:3, :3] @ _AXES[v], model) for v in used]
        return self._listed(views, images, model[VOXEL_SIZE], most)

    def _see(
        self, K: Intrinsics, T: NDArray[np.float64], read: Read, model: NDArray[np.float64]
    ) -> _Sight | None:
        """Compute the clear depths of an image's patches. Returns its view, or None for unusable cameras."""
        self._image.make_room(*read[0].shape)
        camera = self._camera(K, read[0].shape, model)
        read = (np.ascontiguousarray(read[0], np.float32), *read[1:])
        if camera[2][0] <= NEAREST or np.abs(T[:3, 3]).max() > _FARTHEST * model[VOXEL_SIZE]:
            return None
        view = _view(camera, T[:3, 3], T[:3, :3], model)
        image = self._image
        space_carving.find_clear_depths(
            *read, view.numbers, model, image.levels, image.clear, image.least, image.most
        )
        return view

    def _listed(
        self, views: Sequence[_Sight], images: "_PatchImages", voxel_size: float, most: int
    ) -> NDArray[np.int64]:
        """Return the unordered keys of the blocks that images look through; none if more than `most`."""
        cubes, numbers = _cubes_in(views, images), np.concatenate([view.numbers for view in views])
        power = max(0, min(3, math.ceil(math.log2(_LEAST_CUBE / (8 * voxel_size)))))
        keys, count = np.empty(0, np.int64), _FEW
        while len(keys) < count <= most:
            keys = np.empty(count, np.int64)
            self._counts[:] = 0
            space_carving.list_clear_blocks(
                images.clear, *images.pixels, images.levels, images.least, images.most, numbers, cubes, power,
                keys, self._counts,
            )  # fmt: skip
            count = int(self._counts[BLOCKS])
        return keys[: count if count <= most else 0]

    def _camera(self, K: Intrinsics, shape: tuple[int, ...], model: NDArray[np.float64]) -> Optics:
        kind = K, shape, model[MAX_RANGE], model[VOXEL_SIZE]
        if kind != self._kind:
            self._kind, self._found = kind, _camera_of(K, shape, model)
        return self._found

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self._room) + self._image.nbytes + self._points.nbytes


class _PatchImages:
    """Depths up to which 3x3 pixel patches are clear, and their minimum and maximum in squares of patches."""

    def __init__(self) -> None:
        self.pixels = 0, 0  # height, width of each image
        self.clear = np.zeros((0, 0), np.int32)
        self.levels = np.zeros((0, 4), np.int32)
        self.least = self.most = np.zeros(0, np.int32)

    def make_room(self, height: int, width: int) -> None:
        if self.pixels == (height, width):
            return
        rows, columns = -(-height // PATCH), -(-width // PATCH)
        clear = np.zeros((rows, columns), np.int32)
        levels = [(0, -(-rows // 2), -(-columns // 2), rows)]
        while levels[-1][1:3] != (1, 1):
            begin, high, wide, _ = levels[-1]
            levels.append((begin + high * wide, -(-high // 2), -(-wide // 2), rows))
        least, most = (np.zeros(levels[-1][0] + 1, np.int32) for _ in range(2))
        # Set all or, for lack of memory, none
        self.pixels, self.clear, self.levels = (height, width), clear, np.array(levels, np.int32)
        self.least, self.most = least, most

    def use(self, clear: NDArray[np.int32]) -> None:
        """Take the clear depths of images' patches, (n, rows, columns)."""
        squares = int(self.levels[-1, 0]) + 1
        self.clear = clear.reshape(-1, clear.shape[2])
        self.least, self.most = (np.empty(len(clear) * squares, np.int32) for _ in range(2))
        space_carving.fill_levels(self.clear, self.levels, self.least, self.most)

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self.clear, self.levels, self.least, self.most))


# Columns, rows and depths of images of points, as directions in the sensor's frame
_AXES = np.array(
    [np.roll(np.eye(3), axis, axis=0)[:, [1, 2, 0]] * [1, 1, sign] for axis in range(3) for sign in (1, -1)]
)


def _list_of(blocks: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    return np.zeros(blocks, np.int64), np.zeros(blocks, np.int64), np.zeros((blocks, WORDS), np.int64)


def _view(
    camera: Optics, centre: NDArray[np.float64], orientation: NDArray[np.float64], model: NDArray[np.float64]
) -> _Sight:
    matrix, corners, rest = camera
    # Sums in a fixed order are equal on every processor
    directions = matrix[:, :1] * orientation[:, 0] + matrix[:, 1:2] * orientation[:, 1]
    directions += matrix[:, 2:] * orientation[:, 2]
    numbers = np.concatenate([centre / model[VOXEL_SIZE], directions.ravel(), rest])
    return _Sight(numbers, orientation @ corners)


def _cubes_in(views: Sequence[_Sight], images: _PatchImages) -> NDArray[np.int32]:
    """Return an array, (views + 1, 7), of the cubes of 64³ voxels that each view sees: index of its first
    cube in the list of all, its lowest cube (x, y, z), and its cubes per axis."""
    found = np.zeros((len(views) + 1, 7), np.int32)
    deepest = images.most.reshape(len(views), -1)[:, -1]
    for n, (numbers, rays) in enumerate(views):
        centre = numbers[:3]
        ends = centre[:, None] + float(deepest[n]) / numbers[SCALE] * rays
        # A voxel centre never lies on a cube's border
        low, high = np.minimum(centre, ends.min(axis=1)), np.maximum(centre, ends.max(axis=1))
        found[n, 1:] = np.clip(np.floor(np.concatenate([low, high]) / SIDE), -_MOST_CUBES, _MOST_CUBES)
        found[n, 4:] -= found[n, 1:4] - 1
        found[n + 1, 0] = found[n, 0] + found[n, 4:].prod()
    return found


def _thinned(K: Intrinsics, read: Read, model: NDArray[np.float64]) -> tuple[Intrinsics, Read]:
    """Return a camera and its image with fewer pixels, to save time. A pixel stays narrow enough that
    surfaces between pixels have hits in the map."""
    image, is_disparity, scale, confidence, has_confidence = read
    widest = _THIN_VOXELS * model[VOXEL_SIZE] / model[MAX_RANGE]
    step = max(1, min(_THINNEST, int(min(K.fx, abs(K.fy), 1e6) * widest)))
    if step == 1:
        return K, read
    first, (height, width) = step // 2, image.shape
    chosen = tuple(slice(first, first + step * (side // step), step) for side in (height, width))
    thin = np.ascontiguousarray(image[chosen], np.float32)
    if has_confidence:
        confidence = np.ascontiguousarray(confidence[chosen])
    camera = Intrinsics(K.fx / step, K.fy / step, (K.cx - first) / step, (K.cy - first) / step)
    return camera, (thin, is_disparity, scale, confidence, has_confidence)


def _stands(points: PointRays, voxel_size: float) -> Iterator[tuple[PointRays, NDArray[np.float32]]]:
    """Yield parts of a sweep of points, each with one viewpoint; parts whose viewpoint moves are left out."""
    count, reach = len(points.points), _STAND * voxel_size
    parts = min(1 if len(points.starts) == 1 else _MOST_STANDS, count)
    for part in range(parts):
        chosen = slice(count * part // parts, count * (part + 1) // parts)
        starts = points.starts if len(points.starts) == 1 else points.starts[chosen]
        centre = (starts.min(axis=0) + starts.max(axis=0)) / 2
        if np.abs(starts - centre).max() <= reach:
            confidence = points.confidence[chosen] if points.has_confidence else points.confidence
            yield PointRays(points.points[chosen], starts, confidence, points.has_confidence), centre


def _closed(ends: NDArray[np.int32], scale: float, far: float) -> NDArray[np.int32]:
    """Return the depth, in units, up to which patches (n, rows, columns) are clear.

    `ends` has the depths of the points in the patches. A patch without a point is as clear as its neighbours.
    The wider the gap between points, the smaller is its clear depth: sparse points say little about it.
    """
    near, clear = ends, np.zeros_like(ends)
    for gap in range(_GAPS):
        if gap:
            near = np.pad(near, ((0, 0), (1, 1), (1, 1)), constant_values=NO_SAMPLE)
            near = np.minimum(np.minimum(near[:, :-2], near[:, 1:-1]), near[:, 2:])
            near = np.minimum(np.minimum(near[..., :-2], near[..., 1:-1]), near[..., 2:])
        patch = (2 * gap + 2) * 2 * VIEW_TANGENT / _PATCHES  # widest gap between two points, at depth one
        most = np.int32(min(_GAP / patch, far) * scale)
        np.maximum(clear, np.minimum(near, most) * (near < NO_SAMPLE), out=clear)
    return clear


def _camera_of(K: Intrinsics, shape: tuple[int, ...], model: NDArray[np.float64]) -> Optics:
    """Return a camera for the kernels: (3, 3) steps right, down and forward in column · depth, row · depth
    and depth; rays at depth one through the image's corners, (3, 4); the last six numbers of a view."""
    height, width = shape[:2]
    middle = (K.cx + 0.5) / PATCH, (K.cy + 0.5) / PATCH
    matrix = np.array([(K.fx / PATCH, 0, middle[0]), (0, K.fy / PATCH, middle[1]), (0, 0, 1)])
    x = [(u - 0.5 - K.cx) / K.fx for u in (0, width)]
    y = [(v - 0.5 - K.cy) / K.fy for v in (0, height)]
    corners = np.array([(a, b, 1.0) for a in x for b in y])
    widest = max(math.hypot(*corner) for corner in corners)
    # Largest image coordinate, units, one voxel away
    most = _MOST_UNITS / math.sqrt(3) / max(math.hypot(*row) for row in matrix)
    far = min(MAX_CARVED / widest, model[MAX_RANGE] / model[VOXEL_SIZE], (most / _COARSEST - SIDE) / widest)
    if not far > NEAREST:  # false for an impossibly wide image, and for too large numbers
        return matrix, corners.T, np.zeros(6)
    scale = min(2.0 ** math.floor(math.log2(most / (far * widest + SIDE))), FINEST)
    return matrix, corners.T, np.array([far, scale, K.fx, K.fy, K.cx, K.cy])
