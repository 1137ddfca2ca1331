# SPDX-License-Identifier: MIT
"""Convert keyframes, surfaces and slices into ROS 2 messages, by the conventions of REP 103, 105 and 118.

A keyframe's frame is the optical one (x right, y down, z forward), and its parent frame is `world`. Arrays
keep their journaled form: a uint16 depth in millimetres stays uint16, and a JPEG keeps its bytes.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics, Keyframe, depth_metres
from tsfusion.geometry.map_grids import SliceGrid
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.trajectory import quaternion
from tsfusion.journal.mcap_layout import Record
from tsfusion.wire.records.record_header import KeyframeHeader

WORLD = "world"
MARKER, GRID = "visualization_msgs/msg/Marker", "nav_msgs/msg/OccupancyGrid"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
MARKERS = "tsfusion"  # namespace of markers
_TRIANGLE_LIST, _ADD, _DELETE = 11, 0, 2  # visualization_msgs/msg/Marker
_CDR_HEADER = 4  # bytes, from whose end alignment counts
_NO_BYTES = np.zeros(0, np.uint8)
_MILLIMETRE = 0.001
_FLOAT32 = 7  # sensor_msgs/msg/PointField
_STRIDE = 2  # pixels between the points of a cloud


class Outgoing(NamedTuple):
    """One ROS message before serialisation."""

    topic: str
    kind: str
    content: Any


class Converter:
    """Converts keyframes, surfaces and slices into ROS 2 messages.

    Args:
        types: message classes by name (from a rosbags type store).
        clouds: also make clouds from depth images.
        world: name of the frame that poses are in.
    """

    def __init__(self, types: Any, *, clouds: bool = False, world: str = WORLD) -> None:
        self._types, self._clouds, self._world = types, clouds, world

    def convert(
        self, keyframe: Keyframe, header: KeyframeHeader, record: Record, name: str, stamp_ns: int
    ) -> Iterator[Outgoing]:
        """Yield the messages of one keyframe, those of its pose first.

        Args:
            name: the frame's name, and the first part of the topics.
        """
        stamp = self.stamp(stamp_ns)
        yield from self._place(keyframe.T_world_camera, name, stamp)
        heading = self._heading(stamp, name)
        if keyframe.points is not None:
            yield self._cloud(keyframe.points, keyframe.color, f"/{name}/points", heading)
            return
        yield self._image(f"/{name}/depth/image", depth_image(keyframe), heading)
        if keyframe.intrinsics is not None:
            info = self._camera_info(keyframe.intrinsics, keyframe.shape, heading)
            yield Outgoing(f"/{name}/depth/camera_info", "sensor_msgs/msg/CameraInfo", info)
            if keyframe.color is not None:
                yield Outgoing(f"/{name}/color/camera_info", "sensor_msgs/msg/CameraInfo", info)
        if keyframe.color is not None:
            yield self._color(keyframe.color, header, record, f"/{name}/color/image", heading)
        if self._clouds and keyframe.intrinsics is not None:
            yield self._cloud(*cloud_of(keyframe), f"/{name}/points", heading)

    def stamp(self, stamp_ns: int) -> Any:
        return self._make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)

    def place(self, T_world_frame: NDArray[np.float64], name: str, stamp_ns: int) -> Iterator[Outgoing]:
        """Yield the transform of a frame, and its pose."""
        return self._place(T_world_frame, name, self.stamp(stamp_ns))

    def cloud(
        self, points: NDArray[np.float32], color: NDArray[np.uint8] | None, topic: str, stamp_ns: int
    ) -> Outgoing:
        """Return (n, 3) points in the world, with (n, 3) BGR, as a PointCloud2."""
        return self._cloud(points, color, topic, self._heading(self.stamp(stamp_ns), self._world))

    def path(self, points: NDArray[np.float64], topic: str, stamp_ns: int) -> Outgoing:
        """Return (n, 3) positions in the world as a Path, whose poses are not turned."""
        heading = self._heading(self.stamp(stamp_ns), self._world)
        poses = [
            self._make("geometry_msgs/msg/PoseStamped", header=heading, pose=self._pose(one))
            for one in points.tolist()
        ]
        content = self._make("nav_msgs/msg/Path", header=heading, poses=poses)
        return Outgoing(topic, "nav_msgs/msg/Path", content)

    def marker(self, number: int, topic: str, stamp_ns: int, *, remove: bool = False) -> Outgoing:
        """Return a Marker for a list of triangles, which `with_triangles` adds, or that removes it."""
        zero = self._make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
        picture = self._make(
            "sensor_msgs/msg/CompressedImage", header=self._heading(zero, ""), format="", data=_NO_BYTES
        )
        white = self._make("std_msgs/msg/ColorRGBA", r=1.0, g=1.0, b=1.0, a=1.0)
        content = self._make(
            MARKER, header=self._heading(self.stamp(stamp_ns), self._world), ns=MARKERS, id=number,
            type=_TRIANGLE_LIST, action=_DELETE if remove else _ADD, pose=self._pose((0.0, 0.0, 0.0)),
            scale=self._make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0), color=white,
            lifetime=self._make("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=True,
            points=[], colors=[], texture_resource="", texture=picture, uv_coordinates=[], text="",
            mesh_resource="", mesh_use_embedded_materials=False,
            mesh_file=self._make("visualization_msgs/msg/MeshFile", filename="", data=_NO_BYTES),
        )  # fmt: skip
        return Outgoing(topic, MARKER, content)

    def with_triangles(self, empty: bytes, mesh: Mesh) -> bytes:
        """Return the CDR of a Marker of `marker` with the triangles of a mesh, and their colours.

        One Python object a point, as the message classes need, would take a second for 100,000 triangles.
        """
        corners = mesh.faces.reshape(-1)
        rgb = np.full((len(mesh.vertices), 3), 200) if mesh.colors is None else mesh.colors
        shades = np.column_stack([rgb / 255, np.ones(len(rgb))]).astype("<f4")[corners]
        at = _aligned(_aligned(8 + 4 + len(self._world) + 1, 4) + 4 + len(MARKERS) + 1, 4) + 3 * 4
        at = _aligned(at, 8) + 7 * 8 + 3 * 8 + 4 * 4 + 2 * 4 + 1
        at = _CDR_HEADER + _aligned(at, 4)
        count = struct.pack("<I", len(corners))
        gap = bytes(_aligned(at + 4 - _CDR_HEADER, 8) - (at + 4 - _CDR_HEADER)) if len(corners) else b""
        points = mesh.vertices.astype("<f8")[corners].tobytes()
        return b"".join((empty[:at], count, gap, points, count, shades.tobytes(), empty[at + 8 :]))

    def grid(
        self, cells: NDArray[np.int8], grid: SliceGrid, topic: str, frame: str, stamp_ns: int
    ) -> Outgoing:
        """Return a slice's cells (0 free, 100 occupied, −1 unseen) as an OccupancyGrid in its frame."""
        stamp, (rows, columns) = self.stamp(stamp_ns), cells.shape
        place = self._make(
            "nav_msgs/msg/MapMetaData", map_load_time=stamp, resolution=grid.resolution, width=columns,
            height=rows, origin=self._pose((*grid.origin, 0.0)),
        )  # fmt: skip
        content = self._make(
            GRID, header=self._heading(stamp, frame), info=place, data=np.ascontiguousarray(cells).reshape(-1)
        )
        return Outgoing(topic, GRID, content)

    def distances(self, distance: NDArray[np.float32], topic: str, frame: str, stamp_ns: int) -> Outgoing:
        """Return a slice's distances as an Image of 32FC1, metres; row 0 is that of the grid's origin."""
        return self._image(topic, distance, self._heading(self.stamp(stamp_ns), frame))

    def diagnostics(
        self, level: int, name: str, words: str, values: dict[str, object], stamp_ns: int
    ) -> Outgoing:
        """Return a DiagnosticArray with one status; `level`: 0 ok, 1 warning, 2 error, 3 stale."""
        pairs = [
            self._make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ]
        status = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=words, hardware_id=name,
            values=pairs,
        )  # fmt: skip
        content = self._make(DIAGNOSTICS, header=self._heading(self.stamp(stamp_ns), ""), status=[status])
        return Outgoing("/diagnostics", DIAGNOSTICS, content)

    def _pose(self, position: Sequence[float]) -> Any:
        point = self._make("geometry_msgs/msg/Point", **dict(zip("xyz", position, strict=True)))
        turned = self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        return self._make("geometry_msgs/msg/Pose", position=point, orientation=turned)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _heading(self, stamp: Any, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _place(self, T: NDArray[np.float64], name: str, stamp: Any) -> Iterator[Outgoing]:
        x, y, z = T[:3, 3].tolist()
        rotation = dict(zip("xyzw", quaternion(T[:3, :3]).tolist(), strict=True))
        turned = self._make("geometry_msgs/msg/Quaternion", **rotation)
        heading = self._heading(stamp, self._world)
        moved = self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        transform = self._make("geometry_msgs/msg/Transform", translation=moved, rotation=turned)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", header=heading, child_frame_id=name, transform=transform
        )
        yield Outgoing(
            "/tf", "tf2_msgs/msg/TFMessage", self._make("tf2_msgs/msg/TFMessage", transforms=[stamped])
        )
        point = self._make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        pose = self._make("geometry_msgs/msg/Pose", position=point, orientation=turned)
        posed = self._make("geometry_msgs/msg/PoseStamped", header=heading, pose=pose)
        yield Outgoing(f"/{name}/pose", "geometry_msgs/msg/PoseStamped", posed)

    def _image(self, topic: str, image: NDArray[Any], heading: Any) -> Outgoing:
        encoding = {"uint16": "16UC1", "float32": "32FC1", "uint8": "bgr8"}[image.dtype.name]
        rows = np.ascontiguousarray(image, image.dtype.newbyteorder("<")).view(np.uint8)
        height, width = image.shape[:2]
        content = self._make(
            "sensor_msgs/msg/Image",
            header=heading,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.nbytes // height,
            data=rows.reshape(-1),
        )
        return Outgoing(topic, "sensor_msgs/msg/Image", content)

    def _color(
        self, color: NDArray[np.uint8], header: KeyframeHeader, record: Record, topic: str, heading: Any
    ) -> Outgoing:
        index = [buffer.name for buffer in header.buffers].index("color")
        form = header.buffers[index].codec
        if form not in ("jpeg", "png"):
            return self._image(topic, color, heading)
        content = self._make(
            "sensor_msgs/msg/CompressedImage",
            header=heading,
            format=form,
            data=np.frombuffer(record.frames[index + 1], np.uint8),
        )
        return Outgoing(f"{topic}/compressed", "sensor_msgs/msg/CompressedImage", content)

    def _camera_info(self, camera: Intrinsics, shape: tuple[int, ...], heading: Any) -> Any:
        height, width = shape
        no_region = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=heading,
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=camera.matrix.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.column_stack([camera.matrix, np.zeros(3)]).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=no_region,
        )

    def _cloud(
        self, points: NDArray[np.float32], color: NDArray[np.uint8] | None, topic: str, heading: Any
    ) -> Outgoing:
        names = ["x", "y", "z"] + ["rgb"] * (color is not None)
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
            for i, name in enumerate(names)
        ]
        rows = np.zeros((len(points), 4 * len(names)), np.uint8)
        rows[:, :12] = np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1, 12)
        if color is not None:
            rows[:, 12:15] = color  # blue, green, red and a zero: 0x00RRGGBB, as PCL packs it
        content = self._make(
            "sensor_msgs/msg/PointCloud2",
            header=heading,
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=rows.shape[1],
            row_step=rows.size,
            data=rows.reshape(-1),
            is_dense=bool(np.isfinite(points).all()),
        )
        return Outgoing(topic, "sensor_msgs/msg/PointCloud2", content)


def depth_image(keyframe: Keyframe) -> NDArray[Any]:
    """Return a keyframe's depth as REP 118 asks: uint16 millimetres with 0, or float32 metres with NaN.

    Millimetres are copied unchanged; all else is converted to metres.
    """
    if keyframe.depth is None:
        assert keyframe.disparity is not None
        assert keyframe.baseline_fx is not None
        with np.errstate(divide="ignore"):
            return _metres(keyframe.baseline_fx / (keyframe.disparity * keyframe.disparity_scale))
    if keyframe.depth.dtype == np.float32:
        return _metres(keyframe.depth)
    if keyframe.depth_scale == _MILLIMETRE:
        return keyframe.depth
    return _metres(keyframe.depth * keyframe.depth_scale)


def cloud_of(keyframe: Keyframe) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Return (n, 3) camera-frame points of every second row and column of an image, and their colours."""
    z, K = depth_metres(keyframe)[::_STRIDE, ::_STRIDE], keyframe.intrinsics
    assert K is not None
    v, u = np.nonzero(z)
    z = z[v, u]
    x, y = (_STRIDE * u - K.cx) / K.fx * z, (_STRIDE * v - K.cy) / K.fy * z
    color = None if keyframe.color is None else keyframe.color[::_STRIDE, ::_STRIDE][v, u]
    return np.stack([x, y, z], axis=1).astype(np.float32), color


def _aligned(offset: int, size: int) -> int:
    return -(-offset // size) * size


def _metres(depth: NDArray[Any]) -> NDArray[np.float32]:
    with np.errstate(invalid="ignore"):
        is_return = np.isfinite(depth) & (depth > 0)
    metres: NDArray[np.float32] = np.where(is_return, depth, np.nan).astype(np.float32)
    return metres
