# SPDX-License-Identifier: MIT
"""Write genuine ROS 1 and ROS 2 recordings with rosbags."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.trajectory import quaternion

FORMS = ("ros1", "ros1-lz4", "sqlite3", "mcap", "mcap-zstd")
WORLD, BODY, OPTICAL = "map", "base_link", "camera_color_optical_frame"
CAMERA_INFO, TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"


class BagWriter:
    """Messages of one ROS version, made and written; the recorder's clock is the header's, or `log_ns`."""

    def __init__(self, writer: Any, store: Any, *, is2: bool) -> None:
        self._writer, self._store, self._is2 = writer, store, is2
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, content: Any, log_ns: int) -> None:
        kind = content.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        serialize = self._store.serialize_cdr if self._is2 else self._store.serialize_ros1
        self._writer.write(self._connections[topic], log_ns, serialize(content, kind))

    def make(self, kind: str, **fields: Any) -> Any:
        names = self._store.types[kind].__dataclass_fields__
        if "k" in fields and "K" in names:
            fields = {key.upper() if key in "dkrp" else key: value for key, value in fields.items()}
        return self._store.types[kind](**fields)

    def heading(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        more = {} if self._is2 else {"seq": 0}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **more)

    def image(self, topic: str, image: np.ndarray, encoding: str, stamp: int, frame: str = OPTICAL,
              *, big: bool = False, padding: int = 0, **wrong: Any) -> None:  # fmt: skip
        if big:
            image = image.astype(image.dtype.newbyteorder(">"))
        rows = np.ascontiguousarray(image).view(np.uint8).reshape(len(image), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        fields = {
            "height": image.shape[0], "width": image.shape[1], "encoding": encoding, "is_bigendian": int(big),
            "step": rows.shape[1], "data": rows.reshape(-1), **wrong,
        }  # fmt: skip
        content = self.make("sensor_msgs/msg/Image", header=self.heading(stamp, frame), **fields)
        self.write(topic, content, stamp)

    def compressed(self, topic: str, data: bytes, form: str, stamp: int, frame: str = OPTICAL) -> None:
        content = self.make(
            "sensor_msgs/msg/CompressedImage", header=self.heading(stamp, frame), format=form,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip
        self.write(topic, content, stamp)

    def camera_info(self, topic: str, camera: Intrinsics, shape: tuple[int, ...], stamp: int,
                    *, baseline_fx: float = 0.0, **given: Any) -> None:  # fmt: skip
        roi = self.make("sensor_msgs/msg/RegionOfInterest",
                        **{"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False,
                           **given.pop("roi", {})})  # fmt: skip
        P = np.column_stack([camera.matrix, [-baseline_fx, 0, 0]])
        fields = {
            "height": shape[0], "width": shape[1], "distortion_model": "plumb_bob", "d": np.zeros(5),
            "k": camera.matrix.reshape(-1), "r": np.eye(3).reshape(-1), "p": P.reshape(-1),
            "binning_x": 0, "binning_y": 0, "roi": roi, **given,
        }  # fmt: skip
        self.write(topic, self.make(CAMERA_INFO, header=self.heading(stamp, OPTICAL), **fields), stamp)

    def cloud(self, topic: str, records: np.ndarray, stamp: int, frame: str = "velodyne",
              *, big: bool = False, padding: int = 0, **wrong: Any) -> None:  # fmt: skip
        """A structured (height, width) array as it lies in memory."""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make("sensor_msgs/msg/PointField", name=name, offset=records.dtype.fields[name][1],
                      datatype=codes[records.dtype[name].str[1:]], count=1)
            for name in records.dtype.names
        ]  # fmt: skip
        rows = np.frombuffer(records.tobytes(), np.uint8).reshape(len(records), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
        given = {
            "height": records.shape[0], "width": records.shape[1], "fields": fields, "is_bigendian": big,
            "point_step": records.dtype.itemsize, "row_step": rows.shape[1], "data": rows.reshape(-1),
            "is_dense": False, **wrong,
        }  # fmt: skip
        content = self.make("sensor_msgs/msg/PointCloud2", header=self.heading(stamp, frame), **given)
        self.write(topic, content, stamp)

    def transform(self, T: np.ndarray, parent: str, child: str, stamp: int, *, static: bool = False,
                  log_ns: int | None = None) -> None:  # fmt: skip
        content = self.make(TF, transforms=[self.stamped(T, parent, child, stamp)])
        self.write("/tf_static" if static else "/tf", content, stamp if log_ns is None else log_ns)

    def stamped(self, T: np.ndarray, parent: str, child: str, stamp: int) -> Any:
        t, q = self._parts(T, "geometry_msgs/msg/Vector3")
        transform = self.make("geometry_msgs/msg/Transform", translation=t, rotation=q)
        return self.make("geometry_msgs/msg/TransformStamped", header=self.heading(stamp, parent),
                         child_frame_id=child, transform=transform)  # fmt: skip

    def pose(self, T: np.ndarray) -> Any:
        t, q = self._parts(T, "geometry_msgs/msg/Point")
        return self.make("geometry_msgs/msg/Pose", position=t, orientation=q)

    def posed(self, T: np.ndarray, parent: str, stamp: int) -> Any:
        heading = self.heading(stamp, parent)
        return self.make("geometry_msgs/msg/PoseStamped", header=heading, pose=self.pose(T))

    def odometry(self, topic: str, T: np.ndarray, parent: str, child: str, stamp: int) -> None:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        none = np.zeros(36)
        content = self.make(
            "nav_msgs/msg/Odometry", header=self.heading(stamp, parent), child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(T), covariance=none),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )  # fmt: skip
        self.write(topic, content, stamp)

    def imu(
        self,
        topic: str,
        force: np.ndarray,
        stamp: int,
        frame: str,
        *,
        rate: np.ndarray | None = None,
        measured: bool = True,
    ) -> None:
        turned = [0.0] * 3 if rate is None else rate.tolist()
        velocity, acceleration = (
            self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z) for x, y, z in (turned, force.tolist())
        )
        content = self.make(
            "sensor_msgs/msg/Imu", header=self.heading(stamp, frame), angular_velocity=velocity,
            orientation=self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            linear_acceleration=acceleration,
            orientation_covariance=np.zeros(9), angular_velocity_covariance=np.zeros(9),
            linear_acceleration_covariance=np.append(0.0 if measured else -1.0, np.zeros(8)),
        )  # fmt: skip
        self.write(topic, content, stamp)

    def path(self, topic: str, poses: list[tuple[int, np.ndarray]], parent: str, stamp: int) -> None:
        stamped = [self.posed(T, parent, at) for at, T in poses]
        content = self.make("nav_msgs/msg/Path", header=self.heading(stamp, parent), poses=stamped)
        self.write(topic, content, stamp)

    def _parts(self, T: np.ndarray, kind: str) -> tuple[Any, Any]:
        x, y, z = T[:3, 3].tolist()
        turned = dict(zip("xyzw", quaternion(T[:3, :3]).tolist(), strict=True))
        return self.make(kind, x=x, y=y, z=z), self.make("geometry_msgs/msg/Quaternion", **turned)


@contextmanager
def writing(folder: Path, form: str) -> Iterator[tuple[BagWriter, Path]]:
    """A writer of one of `FORMS`, and the path to open afterwards."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    folder.mkdir(exist_ok=True)
    if form.startswith("ros1"):
        path = folder / "recorded.bag"
        bag = rosbag1.Writer(path)
        if form != "ros1":
            bag.set_compression(rosbag1.Writer.CompressionFormat[form[len("ros1-") :].upper()])
        store = get_typestore(Stores.ROS1_NOETIC)
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    else:
        path = folder / "recorded"
        is_sqlite = form.startswith("sqlite3")
        plugin = rosbag2.StoragePlugin.SQLITE3 if is_sqlite else rosbag2.StoragePlugin.MCAP
        bag = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        modes = {"zstd": "MESSAGE", "file": "FILE", "storage": "STORAGE"}
        if (mode := form.partition("-")[2]) in modes:
            bag.set_compression(rosbag2.CompressionMode[modes[mode]], rosbag2.CompressionFormat.ZSTD)
        store = get_typestore(Stores.ROS2_HUMBLE)
    with bag:
        yield BagWriter(bag, store, is2=not form.startswith("ros1")), path


def jpeg(image: np.ndarray, ending: str = ".jpg") -> bytes:
    done, content = cv2.imencode(ending, image)
    assert done
    return content.tobytes()
