# SPDX-License-Identifier: MIT
"""Hold grids of distances and occupancy for robots, and write them as files for planners."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.map_answers import checked_points
from tsfusion.geometry.trajectory import quaternion

FREE, OCCUPIED, UNSEEN = 0, 100, -1  # as in ROS's nav_msgs/OccupancyGrid
SLICE_FORMATS = (".pgm", ".yaml", ".png", ".npz")
# map_server and nav2 read a pixel p as occupied if (255 − p) / 255 > OCCUPIED_THRESH, as free if that is
# < FREE_THRESH, else as unknown. 205 gives 0.19608: the 0.25 of some tools would read unknown cells as free.
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
_PIXELS = {FREE: 254, OCCUPIED: 0, UNSEEN: 205}


@dataclass(frozen=True)
class SliceGrid:
    """The cells of a slice between two heights: rows lie along `axes[1]`, columns along `axes[0]`, and
    `axes[2]` is up.

    The centre of cell (row, column) is at origin + (column + 0.5, row + 0.5) · resolution in the slice's
    frame. Its axes are the rows of `axes`: p_slice = axes @ p_map, without a shift.

    Attributes:
        origin: (2,) metres in the slice's frame, the corner of cell (0, 0).
        resolution: metres a cell.
        shape: rows, columns.
        low, high: metres along up, in the map's frame.
        axes: (3, 3) float64, the slice's axes in the map's frame; the last one is up.
        floor: height of the floor along up from the map's origin, metres; None = no search was made.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> grid = volume.occupancy_slice(0.2, 1.8, up="z").grid
        >>> row, column = grid.cells_of(grid.centres()[3, 5][None])[0]
        >>> int(row), int(column)
        (3, 5)
    """

    origin: tuple[float, float]  # metres: the corner of cell (0, 0)
    resolution: float  # metres: edge of a cell
    shape: tuple[int, int]  # rows, columns
    low: float  # metres from the map's origin
    high: float
    axes: NDArray[np.float64]  # (3, 3)
    floor: float | None = None  # height of the floor, metres; None = no search was made

    def cells_of(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the (n, 2) int64 cells (row, column), maybe outside, of `points` (n, 3) in metres."""
        flat = np.asarray(points, np.float64) @ self.axes[:2].T
        cells: NDArray[np.int64] = np.floor((flat - self.origin) / self.resolution).astype(np.int64)
        return cells[:, ::-1]

    def centres(self, height: float | None = None) -> NDArray[np.float64]:
        """Return the centres of the cells: (rows, columns, 3) float64 metres in the map's frame.

        `height`: metres along up; None = half-way between `low` and `high`.
        """
        rows, columns = (np.arange(count) + 0.5 for count in self.shape)
        u, v = np.meshgrid(columns * self.resolution, rows * self.resolution)
        h = np.full_like(u, (self.low + self.high) / 2 if height is None else height)
        places: NDArray[np.float64] = np.stack([u + self.origin[0], v + self.origin[1], h], axis=-1)
        return places @ self.axes

    @property
    def figures(self) -> dict[str, Any]:
        return {
            "origin": np.array(self.origin), "resolution": np.float64(self.resolution),
            "heights": np.array([self.low, self.high]), "axes": self.axes,
            **({} if self.floor is None else {"floor": np.float64(self.floor)}),
        }  # fmt: skip

    @property
    def heights_in_words(self) -> str:
        """Heights of the slice as text, with the height that they count from."""
        if self.floor is None:
            return f"{self.low:g} and {self.high:g} m"
        low, high = self.low - self.floor, self.high - self.floor
        return f"{low:.4g} and {high:.4g} m above the floor, {self.floor_in_words}"

    @property
    def floor_in_words(self) -> str:
        floor = self.floor or 0.0
        return f"which is {abs(floor):.3f} m {'below' if floor < 0 else 'above'} the map's origin"


@dataclass(frozen=True)
class OccupancySlice:
    """A costmap of the obstacles between two heights.

    `cells` (rows, columns) int8: 0 free, 100 occupied, −1 unseen, as in a `nav_msgs/OccupancyGrid`.

    Attributes:
        grid: positions of the cells.
        knows_free_space: True if free space is known away from surfaces: in all maps except those of earlier
            versions that were fused without `space_carving`.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> costmap = volume.occupancy_slice(0.2, 1.8, up="z")
        >>> [file.name for file in costmap.save("room.yaml")]
        ['room.yaml', 'room.pgm']
    """

    grid: SliceGrid
    cells: NDArray[np.int8]
    knows_free_space: bool  # else free space is known only near surfaces

    def save(self, path: str | Path) -> list[Path]:
        """Write files for ROS's map_server, a picture or arrays; return the files.

        Args:
            path: `.yaml` or `.pgm` writes the pair that map_server reads, `.png` a picture, `.npz` arrays.

        Raises OutputError for a file that cannot be written, InvalidConfig for another suffix.
        """
        path = Path(path)
        suffix = _checked_suffix(path)
        if suffix == ".npz":
            return _save_arrays(path, {"cells": self.cells, **self.grid.figures})
        if suffix == ".png":
            return _save_picture(path, np.repeat(self.pixels()[..., None], 3, axis=2))
        picture, text = path.with_suffix(".pgm"), path.with_suffix(".yaml")
        rows, columns = self.cells.shape
        _write(picture, f"P5\n{columns} {rows}\n255\n".encode() + self.pixels().tobytes())
        _write(text, self._map_server_text(picture.name).encode())
        return [text, picture]

    def pixels(self) -> NDArray[np.uint8]:
        """Return (rows, columns) uint8 for map_server, last row on top: 0 occupied, 254 free, 205 unseen."""
        pixels = np.full(self.cells.shape, _PIXELS[UNSEEN], np.uint8)
        pixels[self.cells == FREE], pixels[self.cells == OCCUPIED] = _PIXELS[FREE], _PIXELS[OCCUPIED]
        return np.ascontiguousarray(pixels[::-1])

    def _map_server_text(self, picture: str) -> str:
        grid = self.grid
        axes = "; ".join(" ".join(f"{one:.6f}" for one in row) for row in grid.axes.tolist())
        turn = " ".join(f"--q{n} {q:.9f}" for n, q in zip("xyzw", quaternion(grid.axes), strict=True))
        return (
            f"# What stands between {grid.heights_in_words}; p_slice = [{axes}] p_map\n"
            "# ros2 run tf2_ros static_transform_publisher --frame-id map --child-frame-id tsfusion_map "
            f"{turn}\n"
            f"image: {json.dumps(picture)}\nmode: trinary\nresolution: {grid.resolution!r}\n"
            f"origin: [{grid.origin[0]!r}, {grid.origin[1]!r}, 0.0]\nnegate: 0\n"
            f"occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n"
        )


@dataclass(frozen=True)
class DistanceSlice:
    """Horizontal distances to the obstacles between two heights.

    `distance` (rows, columns) float32 metres, at most `max_distance`, to the nearest surface. It is negative
    in a cell that is known to lie behind a surface. In unseen cells (too few samples) it is 0, so that robots
    stay away; with `unseen_is_free` it is the distance to the nearest seen surface. `cells` marks these cells
    as an `OccupancySlice` does.

    Attributes:
        grid: positions of the cells.
        max_distance: metres, the `reach`; a distance with this value may in truth be larger.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> around = volume.distance_slice(0.2, 1.8, up="z", max_distance=1.0)
        >>> around.distance.shape == around.cells.shape == around.grid.shape
        True
    """

    grid: SliceGrid
    distance: NDArray[np.float32]
    cells: NDArray[np.int8]
    max_distance: float

    @property
    def reach(self) -> float:
        """Largest distance that the slice can tell, metres."""
        return self.max_distance

    def save(self, path: str | Path) -> list[Path]:
        """Write a picture (.png) or arrays (.npz) to `path`, by its suffix; return the files.

        Raises OutputError for a file that cannot be written, InvalidConfig for another suffix.
        """
        path = Path(path)
        if _checked_suffix(path, (".png", ".npz")) == ".png":
            return _save_picture(path, self.picture())
        return _save_arrays(path, self.arrays())

    def arrays(self) -> dict[str, Any]:
        """Return the arrays and numbers of the slice by name, as the `.npz` file has them."""
        own = {"distance": self.distance, "cells": self.cells, "max_distance": self.max_distance}
        return {**own, **self.grid.figures}

    def picture(self) -> NDArray[np.uint8]:
        """Return (rows, columns, 3) BGR, last row on top: near red, far blue; occupied black, unseen grey."""
        import cv2

        near = np.clip(1 - np.maximum(self.distance, 0) / self.max_distance, 0, 1)
        colors = cv2.applyColorMap((255 * near).astype(np.uint8), cv2.COLORMAP_TURBO)
        colors[self.cells == UNSEEN] = _PIXELS[UNSEEN]
        colors[self.cells == OCCUPIED] = 0
        return np.ascontiguousarray(colors[::-1])


@dataclass(frozen=True)
class DistanceField:
    """Distances to the nearest surface in a box of voxels.

    `distance` (X, Y, Z) float32 metres, at most `max_distance`; negative in voxels that are known to lie
    behind a surface. In unseen voxels it is 0, so that robots stay away; with
    `unseen_is_free` it is the distance to the nearest seen surface. `occupancy` (X, Y, Z) int8 marks the
    voxels: 0 free, 100 occupied, −1 unseen. The centre of voxel (i, j, k) is at
    origin + ((i, j, k) + 0.5) · voxel_size.

    Attributes:
        origin: (3,) float64 metres, the box's low corner.
        voxel_size: metres.
        max_distance: metres, the `reach`; a distance with this value may in truth be larger.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> field = volume.distance_field((-0.5, -0.5, 0.5, 0.5, 0.5, 1.0), max_distance=0.5)
        >>> field.distance.shape
        (20, 20, 10)
        >>> path = np.linspace([-0.4, 0.0, 0.7], [0.4, 0.0, 0.7], 5)
        >>> is_free = field.at(path) >= 0.15  # for a robot of this radius, metres
    """

    origin: NDArray[np.float64]  # (3,) metres: the box's lower corner
    voxel_size: float
    distance: NDArray[np.float32]
    occupancy: NDArray[np.int8]
    max_distance: float

    @property
    def reach(self) -> float:
        """Largest distance that the field can tell, metres."""
        return self.max_distance

    def at(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return lower bounds of the distances at points, from their voxels: (n,) metres; 0 outside the box.

        `points`: (n, 3) metres in the map's frame. Raises InvalidConfig for any other array.
        """
        places = (checked_points(points) - self.origin) / self.voxel_size
        voxels = np.floor(places)
        inside = ((voxels >= 0) & (voxels < self.distance.shape)).all(axis=1)
        found = np.zeros(len(places), np.float32)
        beside = np.linalg.norm(places - voxels - 0.5, axis=1)[inside] * self.voxel_size
        known = self.distance[tuple(voxels[inside].astype(np.int64).T)]
        found[inside] = np.where(known > 0, np.maximum(known - beside, 0), known)
        return found

    def save(self, path: str | Path) -> list[Path]:
        """Write the arrays to `path` (.npz); return the files.

        Raises OutputError for a file that cannot be written, InvalidConfig for another suffix.
        """
        _checked_suffix(path := Path(path), (".npz",))
        return _save_arrays(path, {
            "distance": self.distance, "occupancy": self.occupancy, "origin": self.origin,
            "voxel_size": np.float64(self.voxel_size), "max_distance": np.float64(self.max_distance),
        })  # fmt: skip


def blocked(
    distance: NDArray[np.float32], states: NDArray[np.int8], *, unseen_is_free: bool
) -> NDArray[np.float32]:
    """Return distances for a planner: 0 in unseen cells, unless unseen counts as free."""
    return distance if unseen_is_free else np.where(states == UNSEEN, np.float32(0), distance)


def _checked_suffix(path: Path, known: tuple[str, ...] = SLICE_FORMATS) -> str:
    suffix = path.suffix.lower()
    if suffix not in known:
        raise InvalidConfig(f"{path} must end in {', '.join(known)}")
    return suffix


def _save_arrays(path: Path, arrays: dict[str, Any]) -> list[Path]:
    with durable_files.written(path) as file:
        np.savez_compressed(file, **arrays)
    return [path]


def _save_picture(path: Path, picture: NDArray[np.uint8]) -> list[Path]:
    import cv2  # which no robot needs that only sends

    _write(path, cv2.imencode(".png", picture)[1].tobytes())
    return [path]


def _write(path: Path, content: bytes) -> None:
    with durable_files.written(path) as file:
        file.write(content)
