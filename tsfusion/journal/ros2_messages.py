# SPDX-License-Identifier: MIT
"""Convert keyframes into ROS 2 messages, by the conventions of REP 103, 105 and 118.

A keyframe's frame is the optical one (x right, y down, z forward), and its parent frame is `world`. Arrays
keep their journaled form: a uint16 depth in millimetres stays uint16, and a JPEG keeps its bytes.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics, Keyframe, depth_metres
from tsfusion.geometry.trajectory import quaternion
from tsfusion.journal.mcap_layout import Record
from tsfusion.wire.records.record_header import KeyframeHeader

WORLD = "world"
_MILLIMETRE = 0.001
_FLOAT32 = 7  # sensor_msgs/msg/PointField
_STRIDE = 2  # pixels between the points of a cloud


class Outgoing(NamedTuple):
    """One ROS message before serialisation."""

    topic: str
    kind: str
    content: Any


class Converter:
    """Converts keyframes into ROS 2 messages.

    Args:
        types: message classes by name (from a rosbags type store).
        clouds: also make clouds from depth images.
    """

    def __init__(self, types: Any, *, clouds: bool = False) -> None:
        self._types, self._clouds = types, clouds

    def convert(
        self, keyframe: Keyframe, header: KeyframeHeader, record: Record, name: str, stamp_ns: int
    ) -> Iterator[Outgoing]:
        """Yield the messages of one keyframe, those of its pose first.

        Args:
            name: the frame's name, and the first part of the topics.
        """
        stamp = self._make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
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

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _heading(self, stamp: Any, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _place(self, T: NDArray[np.float64], name: str, stamp: Any) -> Iterator[Outgoing]:
        x, y, z = T[:3, 3].tolist()
        rotation = dict(zip("xyzw", quaternion(T[:3, :3]).tolist(), strict=True))
        turned = self._make("geometry_msgs/msg/Quaternion", **rotation)
        heading = self._heading(stamp, WORLD)
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


def _metres(depth: NDArray[Any]) -> NDArray[np.float32]:
    with np.errstate(invalid="ignore"):
        is_return = np.isfinite(depth) & (depth > 0)
    metres: NDArray[np.float32] = np.where(is_return, depth, np.nan).astype(np.float32)
    return metres
