# SPDX-License-Identifier: MIT
"""Encoding of a keyframe as a multipart message, and the checks of a received record before it is stored.

The checks run cheapest first, and none allocates more than the message itself: frame count and header length,
magic, struct limits, lengths against shapes, sizes stated by compressed frames, finite values and proper
rotation, CRC. Only `decode` decompresses.
"""

import math
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, MAX_POINTS, Keyframe, check_intrinsics, check_pose
from tsfusion.wire.records import array_encoding, corrections
from tsfusion.wire.records.corrections import Correction
from tsfusion.wire.records.record_header import (
    ArrayCodec,
    ArrayName,
    Buffer,
    CorrectionHeader,
    Damaged,
    KeyframeHeader,
    RecordHeader,
    Refused,
    packed,
    unpack,
)

MIN_FRAMES, MAX_FRAMES = 2, 5
_MAX_DECODED_BYTES = 256 << 20  # limit for all arrays of a message together
_MAX_FRAME_BYTES = 32 << 20
_MEASUREMENTS = ("depth", "disparity", "points")
_ZSTD = ("dzp+zstd", "mm+dzp+zstd")

# Allowed dtypes of each array, each with its codecs, for images and for points.
_IMAGE: dict[str, dict[str, tuple[str, ...]]] = {
    "depth": {"uint16": ("dzp+zstd", "png"), "float32": ("dzp+zstd",)},
    "disparity": {"uint16": ("dzp+zstd", "png")},
    "color": {"uint8": ("jpeg", "png", "dzp+zstd")},
    "confidence": {"uint8": ("dzp+zstd", "png")},
}
_POINTS: dict[str, dict[str, tuple[str, ...]]] = {
    "points": {"float32": _ZSTD},
    "origins": {"float32": _ZSTD},
    "color": {"uint8": ("dzp+zstd",)},
    "confidence": {"uint8": ("dzp+zstd",)},
}


def encode(keyframe: Keyframe, *, jpeg_quality: int, **address: Any) -> list[bytes]:
    """Encode a keyframe as frames: the header, then one frame for each array.

    Depth, disparity, points, origins and confidence come back bit for bit; the colour image becomes a JPEG.

    Args:
        address: session, number and map of the record, as of `record_header.packed`.
    """
    buffers, frames = [], []
    for name, array in _arrays(keyframe):
        codec, frame = _pack(name, array, jpeg_quality)
        frames.append(frame)
        buffers.append(
            Buffer(
                name=name,
                codec=codec,
                dtype=array.dtype.name,
                shape=array.shape,
                bytes=len(frame),
                crc32=zlib.crc32(frame),
            )
        )
    scales = {"depth": keyframe.depth_scale, "disparity": keyframe.disparity_scale}
    header = packed(
        KeyframeHeader,
        **address,
        pose=tuple(keyframe.T_world_camera[:3].ravel().tolist()),
        buffers=tuple(buffers),
        scale=scales.get(keyframe.kind),
        intrinsics=keyframe.intrinsics,
        baseline_fx=keyframe.baseline_fx,
        sensor=keyframe.sensor,
        timestamp_ns=keyframe.timestamp_ns,
        captured_ns=keyframe.captured_ns,
    )
    return [header, *frames]


def decode(frames: Sequence[Any]) -> Keyframe | Correction:
    """Decode the keyframe or correction of a message.

    Raises:
        DecodeError: when the bytes are no keyframe and no correction.
        InvalidKeyframe: when the bytes are a keyframe with impossible values.
    """
    header = check(frames)
    if isinstance(header, CorrectionHeader):
        return corrections.unpack(header, frames[1])
    fields: dict[str, Any] = {
        buffer.name: _unpack(buffer, frame) for buffer, frame in zip(header.buffers, frames[1:], strict=True)
    }
    if header.scale is not None:
        fields[f"{measurement(header)}_scale"] = header.scale
    return Keyframe(
        T_world_camera=_pose(header),
        intrinsics=header.intrinsics,
        baseline_fx=header.baseline_fx,
        sensor=header.sensor,
        timestamp_ns=header.timestamp_ns,
        captured_ns=header.captured_ns,
        **fields,
    )


def decode_keyframe(frames: Sequence[Any]) -> Keyframe:
    """Decode the keyframe of a message. Raise as `decode`, and DecodeError for a correction."""
    found = decode(frames)
    if not isinstance(found, Keyframe):
        raise Refused("magic", "a keyframe is expected, got a correction")
    return found


def check(
    frames: Sequence[Any], max_frame_bytes: int = _MAX_FRAME_BYTES, header: RecordHeader | None = None
) -> RecordHeader:
    """Check a received record as far as possible without decompressing it. Return its header.

    Args:
        header: as `unpack` has read it from the first frame; None reads it.

    Raises:
        Refused: (a DecodeError) with a `reason` under which it is counted: `frames`, `header`, `magic`,
            `version`, `limits`, `size`, `payload`, `values` or `crc`. It is a Damaged if the bytes differ
            from what the header announces.
    """
    if not MIN_FRAMES <= len(frames) <= MAX_FRAMES:
        raise Damaged("frames", f"a record has {MIN_FRAMES} to {MAX_FRAMES} frames, got {len(frames)}")
    header = header or unpack(frames[0])
    total = sum(memoryview(frame).nbytes for frame in frames)
    if total > max_frame_bytes:
        raise Refused("size", f"a {header.kind} must be at most {max_frame_bytes} bytes, got {total}")
    if isinstance(header, CorrectionHeader):
        corrections.check(header, frames[1:])
        return header
    _check_limits(header, len(frames))
    _check_values(header)
    _check_bytes(header, frames)
    _check_unfolded_sizes(header, frames)
    return header


def measurement(header: KeyframeHeader) -> str:
    """Return which measurement the keyframe's header announces: `depth`, `disparity` or `points`."""
    return next(buffer.name for buffer in header.buffers if buffer.name in _MEASUREMENTS)


def _check_limits(header: KeyframeHeader, frames: int) -> None:
    names = [buffer.name for buffer in header.buffers]
    if len(names) != frames - 1:
        raise Damaged("limits", f"{frames - 1} arrays came, the header announces {', '.join(names)}")
    if len(set(names)) != len(names):
        raise Refused("limits", f"each array comes once, the header announces {', '.join(names)}")
    kinds = [name for name in names if name in _MEASUREMENTS]
    if len(kinds) != 1:
        raise Refused("limits", f"one of depth, disparity and points is needed, got {len(kinds)}")
    shapes = {buffer.name: buffer.shape for buffer in header.buffers}
    allowed = _POINTS if kinds[0] == "points" else _IMAGE
    expected = _expected_shapes(kinds[0], shapes)
    for buffer in header.buffers:
        if buffer.codec not in allowed.get(buffer.name, {}).get(buffer.dtype, ()):
            raise Refused("limits", f"{buffer.name} of {buffer.dtype} cannot have codec {buffer.codec}")
        if buffer.shape not in expected[buffer.name]:
            raise Refused("limits", f"{buffer.name} cannot have shape {buffer.shape}")
    if sum(map(_decoded_bytes, header.buffers)) > _MAX_DECODED_BYTES:
        raise Refused("limits", f"the arrays decompress to more than {_MAX_DECODED_BYTES} bytes")


def _expected_shapes(kind: str, shapes: dict[ArrayName, tuple[int, ...]]) -> dict[str, list[tuple[int, ...]]]:
    shape = shapes[kind]  # type: ignore[index]
    if kind == "points":
        fits = len(shape) == 2 and shape[1] == 3 and shape[0] <= MAX_POINTS
        one, three, origins = shape[:1], shape, [(3,), shape]
    else:
        fits = len(shape) == 2 and min(shape) >= 1 and max(shape) <= MAX_IMAGE_SIDE
        one, three, origins = shape, (*shape, 3), []
    if not fits:
        raise Refused("limits", f"{kind} cannot have shape {shape}")
    return {kind: [shape], "origins": origins, "color": [three], "confidence": [one]}


def _check_bytes(header: KeyframeHeader, frames: Sequence[Any]) -> None:
    for buffer, frame in zip(header.buffers, frames[1:], strict=True):
        size = memoryview(frame).nbytes
        if size != buffer.bytes:
            raise Damaged("size", f"{buffer.name} was announced with {buffer.bytes} bytes, got {size}")
    for buffer, frame in zip(header.buffers, frames[1:], strict=True):
        if zlib.crc32(frame) != buffer.crc32:
            raise Damaged("crc", f"the bytes of {buffer.name} were damaged on their way (CRC-32 differs)")


def _check_unfolded_sizes(header: KeyframeHeader, frames: Sequence[Any]) -> None:
    for buffer, frame in zip(header.buffers, frames[1:], strict=True):
        if buffer.codec in _ZSTD:
            array_encoding.check_zstd(frame, _decoded_bytes(buffer))
        elif array_encoding.image_size(frame) != buffer.shape[:2]:
            raise Refused("limits", f"the image of {buffer.name} is not {buffer.shape} as announced")


def _check_values(header: KeyframeHeader) -> None:
    kind = measurement(header)
    numbers = [value for value in (header.scale, header.baseline_fx) if value is not None]
    if not all(np.isfinite(value) and value > 0 for value in numbers):
        raise Refused("values", f"scale and baseline_fx must be finite and > 0, got {numbers}")
    try:
        check_pose(_pose(header))
        if header.intrinsics is not None:
            check_intrinsics(header.intrinsics)
    except InvalidKeyframe as error:
        raise Refused("values", str(error)) from error
    if kind != "points" and header.intrinsics is None:
        raise Refused("values", f"{kind} needs intrinsics")
    if kind == "disparity" and header.baseline_fx is None:
        raise Refused("values", "disparity needs baseline_fx")


def _pose(header: KeyframeHeader) -> NDArray[np.float64]:
    return np.array([*header.pose, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)


def _decoded_bytes(buffer: Buffer) -> int:
    return math.prod(buffer.shape) * np.dtype(buffer.dtype).itemsize


def _arrays(keyframe: Keyframe) -> list[tuple[ArrayName, NDArray[Any]]]:
    named: list[tuple[ArrayName, NDArray[Any] | None]] = [
        (keyframe.kind, keyframe.measurement),
        ("origins", keyframe.origins),
        ("color", keyframe.color),
        ("confidence", keyframe.confidence),
    ]
    return [(name, array) for name, array in named if array is not None]


def _pack(name: ArrayName, array: NDArray[Any], jpeg_quality: int) -> tuple[ArrayCodec, bytes]:
    if name == "color" and array.ndim == 3:
        return "jpeg", array_encoding.pack_jpeg(array, jpeg_quality)
    if name in ("points", "origins") and (packed := array_encoding.pack_mm(array)) is not None:
        return "mm+dzp+zstd", packed
    return "dzp+zstd", array_encoding.pack(array)


def _unpack(buffer: Buffer, frame: Any) -> NDArray[Any]:
    dtype = np.dtype(buffer.dtype)
    if buffer.codec == "dzp+zstd":
        return array_encoding.unpack(frame, dtype, buffer.shape)
    if buffer.codec == "mm+dzp+zstd":
        return array_encoding.unpack_mm(frame, buffer.shape)
    return array_encoding.unpack_image(frame, dtype, buffer.shape)
