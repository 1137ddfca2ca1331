# SPDX-License-Identifier: MIT
"""The blocks that the current keyframe's image looks through: found on the CPU, whatever adds to them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Keyframe
from tsfusion.kernels import space_carving
from tsfusion.kernels.sensor_noise import MAX_CARVED, MAX_RANGE, VOXEL_SIZE
from tsfusion.kernels.space_carving import BLOCKS, FAR, FINEST, NEAREST, PATCH, SCALE, SIDE, VOXELS, WORDS
from tsfusion.kernels.voxel_traversal import VOXEL_LIMIT

_FEW = 1024  # blocks of the first list
_MOST_UNITS = 1 << 30  # of a place in an image
_COARSEST = 64  # units a voxel
_MOST_CUBES = VOXEL_LIMIT // SIDE - 1  # from the map's origin each way
_FARTHEST = VOXEL_LIMIT - SIDE  # voxels, of a camera from there


# The image, whether it has disparities, scale, confidence or anything, whether there is confidence: as the
# kernels take them.
Read = tuple[NDArray[np.float32], int, float, NDArray[Any], int]


class CarvedBlocks:
    """Keys of blocks, which of their voxels are clear, and what is added to each of these."""

    def __init__(self) -> None:
        self.voxels = 0  # clear ones
        self.keys = np.empty(0, np.int64)
        self.amounts = np.empty(0, np.int64)
        self.masks = np.empty((0, WORDS), np.int64)
        self._room = _list_of(0)
        self._counts = np.zeros(2, np.int32)
        self._kind: tuple[object, ...] = ()  # of the camera that this is:
        self._found: tuple[NDArray[np.float64], ...] = ()
        self._shape = 0, 0  # of the image that these are for:
        self._clear = np.zeros((0, 0), np.int32)
        self._levels = np.zeros((0, 3), np.int32)
        self._least = self._most = np.zeros(0, np.int32)

    def __len__(self) -> int:
        return len(self.keys)

    def forget(self) -> None:
        """Have no blocks: the keyframe carves nothing."""
        self.voxels = 0
        self.keys, self.amounts, self.masks = (array[:0] for array in self._room)

    def find(self, keyframe: Keyframe, read: Read, model: NDArray[np.float64], most: int) -> None:
        """Find the blocks of a keyframe's image.

        Args:
            keyframe: one with an image.
            read: its image, and how it is read.
            model: the sensor model, as for `rays_from_images`.
            most: blocks that a keyframe may touch; if there are more, one more than that is listed.
        """
        self.forget()
        self._make_room(*read[0].shape)
        matrix, corners, rest = self._camera(keyframe, model)
        T = keyframe.T_world_camera
        centre, orientation = T[:3, 3] / model[VOXEL_SIZE], np.ascontiguousarray(T[:3, :3])
        # sums one after the other, as every processor makes them
        directions = matrix[:, :1] * orientation[:, 0] + matrix[:, 1:2] * orientation[:, 1]
        directions += matrix[:, 2:] * orientation[:, 2]
        view = np.concatenate([centre, directions.ravel(), rest])
        if view[FAR] <= NEAREST or np.abs(centre).max() > _FARTHEST:
            return
        space_carving.find_clear_depths(
            *read, view, model, self._levels, self._clear, self._least, self._most
        )
        far = float(self._most[-1]) / view[SCALE]
        ends = centre[:, None] + far * (orientation @ corners)  # a voxel's centre is no cube's border
        low = np.minimum(centre, ends.min(axis=1)) / SIDE
        high = np.maximum(centre, ends.max(axis=1)) / SIDE
        cubes = np.clip(np.floor(np.concatenate([low, high])), -_MOST_CUBES, _MOST_CUBES).astype(np.int32)
        cubes[3:] -= cubes[:3] - 1
        while True:
            self._counts[:] = 0
            space_carving.list_free_blocks(
                self._clear, *self._shape, self._levels, self._least, self._most, view, model, cubes,
                *self._room, self._counts,
            )  # fmt: skip
            count, room = int(self._counts[BLOCKS]), len(self._room[0])
            if count <= room or room > most:
                break
            self._room = _list_of(min(4 * room, most + 1))
        self.keys, self.amounts, self.masks = (array[:count] for array in self._room)
        self.voxels = int(self._counts[VOXELS])

    def _camera(self, keyframe: Keyframe, model: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """`_camera_of` a keyframe, which is nearly always that of the keyframe before."""
        kind = keyframe.intrinsics, keyframe.shape, model[MAX_RANGE], model[VOXEL_SIZE]
        if kind != self._kind:
            self._kind, self._found = kind, _camera_of(keyframe, model)
        return self._found

    def _make_room(self, height: int, width: int) -> None:
        if self._shape == (height, width):
            return
        if not len(self._room[0]):
            self._room = _list_of(_FEW)
        rows, columns = -(-height // PATCH), -(-width // PATCH)
        clear = np.zeros((rows, columns), np.int32)
        levels = [(0, -(-rows // 2), -(-columns // 2))]
        while levels[-1][1:] != (1, 1):
            begin, rows, columns = levels[-1]
            levels.append((begin + rows * columns, -(-rows // 2), -(-columns // 2)))
        least, most = (np.zeros(levels[-1][0] + 1, np.int32) for _ in range(2))
        # all of them, or none where there is no memory
        self._shape, self._clear, self._levels = (height, width), clear, np.array(levels, np.int32)
        self._least, self._most = least, most

    @property
    def nbytes(self) -> int:
        """Memory, bytes."""
        arrays = *self._room, self._clear, self._levels, self._least, self._most
        return sum(array.nbytes for array in arrays)


def _list_of(blocks: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    return np.zeros(blocks, np.int64), np.zeros(blocks, np.int64), np.zeros((blocks, WORDS), np.int64)


def _camera_of(keyframe: Keyframe, model: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """A camera: what a step right, down and forward adds to column · depth, row · depth and depth, (3, 3);
    rays of depth one through the image's corners, (3, 4); and the last six numbers of a view."""
    K, (height, width) = keyframe.intrinsics, keyframe.shape[:2]
    assert K is not None  # checked by Keyframe
    middle = (K.cx + 0.5) / PATCH, (K.cy + 0.5) / PATCH
    matrix = np.array([(K.fx / PATCH, 0, middle[0]), (0, K.fy / PATCH, middle[1]), (0, 0, 1)])
    x = [(u - 0.5 - K.cx) / K.fx for u in (0, width)]
    y = [(v - 0.5 - K.cy) / K.fy for v in (0, height)]
    corners = np.array([(a, b, 1.0) for a in x for b in y])
    widest = max(math.hypot(*corner) for corner in corners)
    # the most units of a place in the image, of one that lies a voxel away
    most = _MOST_UNITS / math.sqrt(3) / max(math.hypot(*row) for row in matrix)
    far = min(MAX_CARVED / widest, model[MAX_RANGE] / model[VOXEL_SIZE], (most / _COARSEST - SIDE) / widest)
    if not far > NEAREST:  # as wide an image is no camera's; also where numbers are too large
        return matrix, corners.T, np.zeros(6)
    scale = min(2.0 ** math.floor(math.log2(most / (far * widest + SIDE))), FINEST)
    return matrix, corners.T, np.array([far, scale, K.fx, K.fy, K.cx, K.cy])
