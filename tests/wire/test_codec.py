# SPDX-License-Identifier: MIT
"""Keyframes survive the wire to the bit, the format stays, and strangers' bytes are turned away."""

import inspect
import struct
import zlib
from contextlib import suppress

import cv2
import msgspec
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from repository import GOLDEN

from tsfusion import Keyframe
from tsfusion.core.config import ServerConfig, override
from tsfusion.core.errors import DecodeError, InvalidConfig, InvalidKeyframe
from tsfusion.wire.records import array_encoding, codec
from tsfusion.wire.records.record_header import VERSION, Refused, pack, unpack, with_fields

SESSION = bytes(range(16))


def encode(keyframe: Keyframe) -> list[bytes]:
    return codec.encode(keyframe, session=SESSION, seq=7, jpeg_quality=90)


def points(rng: np.random.Generator, n: int, *, whole_mm: bool) -> np.ndarray:
    if whole_mm:
        return (rng.integers(-80_000, 80_000, (n, 3)) / 1000).astype(np.float32)
    return rng.normal(0, 20, (n, 3)).astype(np.float32)


def keyframes() -> dict[str, Keyframe]:
    rng = np.random.default_rng(3)
    confidence = rng.integers(0, 256, SHAPE).astype(np.uint8)
    metres = rng.uniform(0, 5, SHAPE).astype(np.float32)
    metres[:3] = np.nan
    cloud = points(rng, 400, whole_mm=False)
    cloud[5] = np.inf
    camera = {"intrinsics": CAMERA, "T_world_camera": pose(1 / 3, -2e5, 1e-300)}
    scanner = {"T_world_camera": pose(0.1)}
    return {
        "depth": wall(confidence=confidence, sensor="kinect", captured_ns=2**62),
        "extremes": Keyframe(depth=rng.integers(0, 65536, (3, 5)).astype(np.uint16), **camera),
        "one pixel": Keyframe(depth=np.full((1, 1), 65535, np.uint16), depth_scale=1 / 5000, **camera),
        "metres": Keyframe(depth=metres, baseline_fx=40.2, **camera),
        "disparity": Keyframe(
            disparity=rng.integers(0, 2048, SHAPE).astype(np.uint16), baseline_fx=386.1, **camera
        ),
        "mm": Keyframe(points=points(rng, 500, whole_mm=True), origins=np.zeros(3, np.float32), **scanner),
        "points": Keyframe(
            points=cloud,
            origins=points(rng, 400, whole_mm=False),
            color=rng.integers(0, 256, (400, 3)).astype(np.uint8),
            confidence=np.full(400, 9, np.uint8),
            **scanner,
        ),
        "no points": Keyframe(points=np.zeros((0, 3), np.float32), **scanner),
        "negative zero": Keyframe(points=np.array([[-0.0, 0.001, 1.0]], np.float32), **scanner),
    }  # fmt: skip


EXACT = ("depth", "disparity", "points", "origins", "confidence", "T_world_camera")
SAME = (
    *("depth_scale", "disparity_scale", "baseline_fx", "intrinsics"),
    *("sensor", "timestamp_ns", "captured_ns", "kind"),
)


@pytest.mark.parametrize("name", keyframes())
def test_a_keyframe_comes_back_bit_for_bit(name: str) -> None:
    sent = keyframes()[name]
    came = codec.decode(encode(sent))
    for field in EXACT:
        here, there = getattr(sent, field), getattr(came, field)
        assert (here is None) == (there is None), field
        if here is not None:
            assert (here.dtype, here.shape, here.tobytes()) == (there.dtype, there.shape, there.tobytes()), (
                field
            )
    assert all(getattr(sent, field) == getattr(came, field) for field in SAME)


def test_image_colour_is_close_and_point_colour_exact() -> None:
    sent = wall()
    assert sent.color is not None
    came = codec.decode(encode(sent))
    assert came.color is not None
    assert np.abs(came.color.astype(int) - sent.color).mean() < 4
    cloud = keyframes()["points"]
    assert np.array_equal(codec.decode(encode(cloud)).color, cloud.color)


def test_points_in_whole_millimetres_travel_as_integers() -> None:
    frames = {name: codec.check(encode(keyframe)).buffers[0] for name, keyframe in keyframes().items()}
    assert frames["mm"].codec == "mm+dzp+zstd"
    assert frames["points"].codec == frames["negative zero"].codec == "dzp+zstd"


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_array_comes_back(data: st.DataObject) -> None:
    dtype = data.draw(st.sampled_from([np.uint8, np.uint16, np.float32]))
    shape = data.draw(st.sampled_from([(0, 3), (1,), (7, 3), (4, 5), (2, 3, 3)]))
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    array = np.frombuffer(data.draw(st.binary(min_size=size, max_size=size)), dtype).reshape(shape)
    back = array_encoding.unpack(array_encoding.pack(array), np.dtype(dtype), shape)
    assert back.tobytes() == array.tobytes()
    assert back.shape == shape


def test_png_depth_is_accepted() -> None:
    sent = wall()
    frames = encode(Keyframe(depth=sent.depth, intrinsics=CAMERA, T_world_camera=pose()))
    png = bytes(cv2.imencode(".png", sent.depth)[1])
    came = codec.decode(rewrite([frames[0], png], 0, codec="png"))
    assert np.array_equal(came.depth, sent.depth)


def test_stamp_changes_only_what_it_says() -> None:
    frames = encode(wall())
    before, after = unpack(frames[0]), unpack(with_fields(frames[0], previous=3, sent_ns=99))
    assert (after.previous, after.sent_ns) == (3, 99)
    assert msgspec.structs.replace(after, previous=before.previous, sent_ns=0) == before


# --- the golden files: what is on disks and on its way must stay readable ---


def golden(name: str) -> list[bytes]:
    stored = (GOLDEN / f"{name}.bin").read_bytes()
    (count,) = struct.unpack_from("<B", stored)
    lengths = struct.unpack_from(f"<{count}I", stored, 1)
    at, frames = 1 + 4 * count, []
    for length in lengths:
        frames.append(stored[at : at + length])
        at += length
    return frames


@pytest.mark.parametrize("name", ["depth", "points"])
def test_golden_messages_of_version_1_decode(name: str) -> None:
    frames = golden(f"keyframe-v1-{name}")
    assert VERSION == 1, "a new major version needs golden files of its own beside the old ones"
    assert pack(unpack(frames[0])) == frames[0]
    wanted, came = keyframes()[name], codec.decode(frames)
    for field in EXACT:
        here, there = getattr(wanted, field), getattr(came, field)
        assert here is None or here.tobytes() == there.tobytes(), field
    assert all(getattr(wanted, field) == getattr(came, field) for field in SAME)


def test_fields_of_later_minor_versions_are_skipped() -> None:
    frames = golden("keyframe-v1-depth")
    fields = msgspec.msgpack.decode(frames[0][4:])
    fields["exposure_ns"] = 5
    codec.decode([frames[0][:4] + msgspec.msgpack.encode(fields), *frames[1:]])


def test_a_record_names_its_world_only_where_there_is_one() -> None:
    """So that the records of before keep their bytes; the sender may say it of one that waited."""
    (head, *_) = golden("keyframe-v1-depth")
    assert pack(unpack(with_fields(head, world="", same_frame=False))) == head
    moved = unpack(with_fields(head, map="yard", world="w", same_frame=True))
    assert (moved.map, moved.world, moved.same_frame) == ("yard", "w", True)


# --- strangers ---


def rewrite(
    frames: list[bytes], at: int | None = None, *, fix: bool = True, **changes: object
) -> list[bytes]:
    """The message with fields of its header (or of buffer `at`) changed, lengths and CRC made right again."""
    fields = msgspec.msgpack.decode(frames[0][4:])
    (fields if at is None else fields["buffers"][at]).update(changes)
    if fix:
        for buffer, frame in zip(fields["buffers"], frames[1:], strict=True):
            buffer |= {"bytes": len(frame), "crc32": zlib.crc32(frame)}
    return [frames[0][:4] + msgspec.msgpack.encode(fields), *frames[1:]]


def bad_messages() -> dict[str, tuple[str, list[bytes]]]:
    good = encode(wall())
    identity = [float(value) for value in np.eye(4)[:3].ravel()]
    bomb = zstandard.ZstdCompressor().compress(bytes(64 << 20))
    return {
        "no frames": ("frames", []),
        "header alone": ("frames", good[:1]),
        "six frames": ("frames", [*good, *good]),
        "empty header": ("magic", [b"", *good[1:]]),
        "long header": ("header", rewrite(good, field_of_a_newer_client="x" * 5000)),
        "other magic": ("magic", [b"GET / HTTP/1.1", *good[1:]]),
        "other version": ("version", [b"TSF\x02" + good[0][4:], *good[1:]]),
        "no msgpack": ("header", [b"TSF\x01\xc1\xc1", *good[1:]]),
        "half a header": ("header", [good[0][:60], *good[1:]]),
        "nested without end": ("header", [b"TSF\x01" + b"\x91" * 4000, *good[1:]]),
        "seq 0": ("header", rewrite(good, seq=0)),
        "short session": ("header", rewrite(good, session=b"abc")),
        "unknown array": ("header", rewrite(good, 0, name="pickle")),
        "huge image": ("header", rewrite(good, 0, shape=[1 << 40, 1])),
        "negative size": ("header", rewrite(good, 0, shape=[-1, 5])),
        "wide image": ("limits", rewrite(good, 0, shape=[1, 8193])),
        "huge whole": ("limits", rewrite(rewrite(good, 0, shape=[8192, 8192]), 1, shape=[8192, 8192, 3])),
        "flat image": ("limits", rewrite(good, 0, shape=[48, 64, 1])),
        "no measurement": ("limits", rewrite(good, 0, name="confidence")),
        "float colour": ("limits", rewrite(good, 1, dtype="float32")),
        "other size of colour": ("limits", rewrite(good, 1, shape=[48, 63, 3])),
        "one array too few": ("limits", good[:2]),
        "twice the same": ("limits", rewrite(good, 1, name="depth")),
        "short frame": ("size", [good[0], good[1][:-1], good[2]]),
        "bomb": ("limits", rewrite([good[0], bomb, good[2]])),
        "no zstd": ("payload", rewrite([good[0], b"not compressed", good[2]])),
        "no image": ("payload", rewrite([good[0], good[1], b"\xff\xd8\xff\xe0"])),
        "larger JPEG": (
            "limits",
            rewrite([*good[:2], bytes(cv2.imencode(".jpg", np.zeros((480, 640, 3), np.uint8))[1])]),
        ),
        "NaN pose": ("values", rewrite(good, pose=[float("nan"), *identity[1:]])),
        "sheared pose": ("values", rewrite(good, pose=[1.0, 0.5, *identity[2:]])),
        "far away": ("values", rewrite(good, pose=[*identity[:3], 1e7, *identity[4:]])),
        "no focal length": ("values", rewrite(good, intrinsics=[0.0, 40.0, 1.0, 1.0])),
        "no intrinsics": ("values", rewrite(good, intrinsics=None)),
        "infinite scale": ("values", rewrite(good, scale=float("inf"))),
        "flipped bit": ("crc", [good[0], good[1][:-1] + bytes([good[1][-1] ^ 1]), good[2]]),
    }


@pytest.mark.parametrize("name", bad_messages())
def test_a_bad_message_is_refused_for_its_reason(name: str) -> None:
    reason, frames = bad_messages()[name]
    with pytest.raises(Refused) as refused:
        codec.check(frames)
    assert refused.value.reason == reason
    with pytest.raises(DecodeError):
        codec.decode(frames)


def test_limits_are_the_servers() -> None:
    frames = encode(wall())
    total = sum(map(len, frames))
    codec.check(frames, max_frame_bytes=total)
    with pytest.raises(Refused, match=f"at most {total - 1} bytes"):
        codec.check(frames, max_frame_bytes=total - 1)


def test_the_first_limit_that_is_passed_is_named() -> None:
    """Each has to hold by itself: what comes behind it may change."""
    good = encode(wall())
    fields = msgspec.msgpack.decode(good[0][4:])
    fields["buffers"].append(fields["buffers"][1])
    twice = [good[0][:4] + msgspec.msgpack.encode(fields), *good[1:], good[2]]
    huge = rewrite(rewrite(good, 0, shape=[8192, 8192]), 1, shape=[8192, 8192, 3])
    for frames, message in ((twice, "each array comes once"), (huge, "decompress to more than")):
        with pytest.raises(Refused, match=message):
            codec.check(frames)


def test_an_image_of_other_numbers_than_announced_is_refused() -> None:
    frames = encode(wall())
    png = bytes(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1])
    with pytest.raises(Refused, match=r"was announced, got \(48, 64\) uint8"):
        codec.decode(rewrite([frames[0], png, frames[2]], 0, codec="png"))


def test_no_server_takes_a_message_that_no_fuser_decodes() -> None:
    most = ServerConfig().max_frame_bytes
    assert inspect.signature(codec.check).parameters["max_frame_bytes"].default == most
    with pytest.raises(InvalidConfig, match="max_frame_bytes"):
        override(ServerConfig(), max_frame_bytes=most + 1)


def test_what_passes_the_door_may_still_fail_in_decode() -> None:
    good = encode(wall())
    cut = good[1][: len(good[1]) // 2]
    with pytest.raises(Refused, match="zstd") as refused:
        codec.decode(rewrite([good[0], cut, good[2]]))
    assert refused.value.reason == "payload"


def test_values_that_only_show_when_decoded_are_refused() -> None:
    cloud = keyframes()["points"]
    assert cloud.origins is not None
    broken = cloud.origins.copy()
    broken[0] = np.inf
    frames = encode(cloud)
    frames[2] = array_encoding.pack(broken)
    with pytest.raises(InvalidKeyframe, match="origins"):
        codec.decode(rewrite(frames))


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_mutated_messages_decode_or_are_refused(seed: int, flips: int) -> None:
    rng = np.random.default_rng(seed)
    frames = [bytearray(frame) for frame in encode(wall())]
    for _ in range(flips):
        frame = frames[0] if rng.random() < 0.7 else frames[rng.integers(len(frames))]
        frame[rng.integers(len(frame))] = rng.integers(256)
    with suppress(DecodeError, InvalidKeyframe):
        codec.decode(frames)
