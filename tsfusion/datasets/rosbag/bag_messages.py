# SPDX-License-Identifier: MIT
"""Convert ROS messages to arrays: images, compressed images, point clouds and cameras.

The code follows sensor_msgs, REP 118 (depth) and image_transport's plugins. A message that contradicts itself
raises DatasetError; the caller adds which message it was.
"""

import struct
from io import BytesIO
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.readers import decode_image
from tsfusion.datasets.scan_files import Scan, time_field
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA = "sensor_msgs/msg/CameraInfo"
CLOUD = "sensor_msgs/msg/PointCloud2"

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
_QUANTISATION = struct.Struct("<iff")  # compressed_depth_image_transport's ConfigHeader

# Encoding → stored type, channels, and OpenCV's conversion to BGR (None = not needed). ROS names a Bayer
# pattern by its first row, OpenCV by its second row from the second column.
_PIXELS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "8UC1": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2BGR),
    "16UC1": ("u2", 1, None),
    "mono16": ("u2", 1, None),
    "32FC1": ("f4", 1, None),
}
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class CameraInfo(NamedTuple):
    """Content of a CameraInfo. `P` is for the rectified image; `K`, `D` and `R` are for the raw image."""

    width: int
    height: int
    model: str
    K: NDArray[np.float64]  # (3, 3)
    D: NDArray[np.float64]
    R: NDArray[np.float64]  # (3, 3)
    P: NDArray[np.float64]  # (3, 4); all 0 = not calibrated


def encoding(message: Any) -> str:
    """Return the encoding of an Image's or CompressedImage's pixels, by ROS's name."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    return str(message.format).split(";")[0].strip()


def is_depth(message: Any) -> bool:
    """Return True if an Image or CompressedImage holds 16-bit or floating-point pixels."""
    return encoding(message) in DEPTH_ENCODINGS


def check_image(message: Any) -> None:
    """Raise DatasetError unless an Image holds the bytes required by its size and step."""
    _layout(message)


def depth(message: Any) -> NDArray[Any]:
    """Return (H, W) depth: uint16, in millimetres unless a driver says otherwise, or float32 metres."""
    image = _stored(message) if hasattr(message, "encoding") else _decoded_depth(message)
    if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
        raise DatasetError(f"is no depth image: {encoding(message)} of shape {image.shape}")
    return image


def color(message: Any) -> NDArray[np.uint8]:
    """Return an image as (H, W, 3) uint8 BGR."""
    if not hasattr(message, "encoding"):
        return _decoded(message, cv2.IMREAD_COLOR)
    conversion = _PIXELS.get(message.encoding, ("", 0, None))[2]
    image = _stored(message)
    if image.dtype != np.uint8:
        raise DatasetError(f"is no colour image: {message.encoding}")
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion), np.uint8)


def gray(message: Any) -> NDArray[np.uint8]:
    """Return an image as (H, W) uint8 grey."""
    if not hasattr(message, "encoding"):
        return _decoded(message, cv2.IMREAD_GRAYSCALE)
    if message.encoding in ("mono8", "8UC1"):
        return _stored(message)
    return np.asarray(cv2.cvtColor(color(message), cv2.COLOR_BGR2GRAY), np.uint8)


def _layout(message: Any) -> tuple[np.dtype[Any], int]:
    """Return an Image's pixel type and channels. Raise DatasetError if sizes contradict each other."""
    if message.encoding not in _PIXELS:
        raise DatasetError(f"has the encoding {message.encoding!r}; readable are {', '.join(_PIXELS)}")
    kind, channels, _ = _PIXELS[message.encoding]
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    least = message.width * channels * dtype.itemsize
    if not (0 < message.width <= MAX_IMAGE_SIDE and 0 < message.height <= MAX_IMAGE_SIDE):
        raise DatasetError(f"is {message.width}×{message.height}; expected 1 to {MAX_IMAGE_SIDE} pixels each")
    if message.step < least or message.step * message.height > len(message.data):
        raise DatasetError(
            f"of {message.width}×{message.height} pixels {message.encoding} has {len(message.data)} bytes in "
            f"rows of {message.step}; expected rows of at least {least}"
        )
    return dtype, channels


def _stored(message: Any) -> NDArray[Any]:
    dtype, channels = _layout(message)
    shape = (message.height, message.width) + ((channels,) if channels > 1 else ())
    strides = (message.step, channels * dtype.itemsize) + ((dtype.itemsize,) if channels > 1 else ())
    view: NDArray[Any] = np.ndarray(shape, dtype, np.ascontiguousarray(message.data), 0, strides)
    native: NDArray[Any] = np.ascontiguousarray(view, dtype.newbyteorder("="))
    return native


def _decoded(message: Any, flags: int, start: int = 0) -> NDArray[Any]:
    content = np.ascontiguousarray(message.data, np.uint8)[start:]
    image = decode_image(BytesIO(content.data), flags)
    if image is None:
        raise DatasetError(f"of {len(message.data)} bytes cannot be decoded as {message.format!r}")
    return image


def _decoded_depth(message: Any) -> NDArray[Any]:
    """Decode PNG, or image_transport's compressedDepth: 12 bytes, then a PNG; metres as inverse depth."""
    if "compressedDepth" not in message.format:
        return _decoded(message, cv2.IMREAD_UNCHANGED)
    if "rvl" in message.format.lower():
        raise DatasetError("is compressed by RVL, which cannot be read; expected PNG")
    if len(message.data) <= _QUANTISATION.size:
        raise DatasetError(f"of {len(message.data)} bytes has no image after its header")
    stored = _decoded(message, cv2.IMREAD_UNCHANGED, _QUANTISATION.size)
    if encoding(message) != "32FC1":
        return stored
    _, a, b = _QUANTISATION.unpack_from(bytes(message.data[: _QUANTISATION.size]))
    with np.errstate(divide="ignore"):
        metres = np.float32(a) / (stored.astype(np.float32) - np.float32(b))
    return np.asarray(np.where(stored > 0, metres, np.nan), np.float32)


def check_cloud(message: Any) -> None:
    """Raise DatasetError unless a PointCloud2 has x, y and z, and the bytes required by its size."""
    _records(message)


def cloud(message: Any) -> Scan:
    """Return a PointCloud2's points, with colours and times if any. A point (0, 0, 0), no return, is NaN."""
    records = _records(message)
    points = np.column_stack([records[axis].ravel().astype(np.float32) for axis in "xyz"])
    points[~points.any(axis=1)] = np.nan
    names = records.dtype.names or ()
    packed = next((records[name].ravel() for name in ("rgb", "rgba") if name in names), None)
    bgr = None
    if packed is not None and packed.dtype.kind == "u":
        bgr = np.stack([packed >> shift & 255 for shift in (0, 8, 16)], axis=1).astype(np.uint8)
    field = time_field(names)
    return Scan(points, field, None if field is None else records[field].ravel(), bgr)


def _records(message: Any) -> NDArray[Any]:
    """Return a (height, width) structured array over a PointCloud2's bytes."""
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for one in message.fields:
        kind = _FIELD_TYPES.get(one.datatype)
        if one.name in names or kind is None or one.count == 0:
            continue
        dtype = np.dtype(order + ("u4" if one.name in ("rgb", "rgba") and kind == "f4" else kind))
        if one.offset + dtype.itemsize > message.point_step:
            raise DatasetError(f"has the field {one.name} beyond its {message.point_step} bytes a point")
        names.append(one.name)
        formats.append(dtype)
        offsets.append(one.offset)
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise DatasetError(f"has no field {missing[0]}: its fields are {', '.join(names) or 'none'}")
    layout = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    )
    row = message.row_step or message.width * message.point_step
    needed = max(0, message.height - 1) * row + message.width * message.point_step
    if row < message.width * message.point_step or needed > len(message.data):
        raise DatasetError(
            f"of {message.width}×{message.height} points has {len(message.data)} bytes in rows of {row}; "
            f"expected {message.point_step} a point"
        )
    shape, strides = (message.height, message.width), (row, message.point_step)
    if not message.height * message.width:
        return np.empty((0, 0), layout)
    records: NDArray[Any] = np.ndarray(shape, layout, np.ascontiguousarray(message.data), 0, strides)
    return records


def camera(message: Any) -> CameraInfo:
    """Return a CameraInfo with `K` and `P` changed for the images' binning and region of interest."""
    K, D, R, P = (
        np.array(getattr(message, name, getattr(message, name.upper(), None)), np.float64) for name in "kdrp"
    )
    K, R, P = K.reshape(3, 3).copy(), R.reshape(3, 3), P.reshape(3, 4).copy()
    width, height, roi = message.width, message.height, message.roi
    if roi.width and roi.height:
        K[0, 2] -= roi.x_offset
        K[1, 2] -= roi.y_offset
        P[:2, :3] -= np.outer([roi.x_offset, roi.y_offset], P[2, :3])
        width, height = roi.width, roi.height
    for axis, bins in enumerate((message.binning_x, message.binning_y)):
        K[axis] /= max(1, bins)
        P[axis] /= max(1, bins)
    return CameraInfo(
        width // max(1, message.binning_x),
        height // max(1, message.binning_y),
        str(message.distortion_model),
        K,
        D,
        R,
        P,
    )
