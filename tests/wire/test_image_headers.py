# SPDX-License-Identifier: MIT
"""A compressed image costs what it announces: what its decoder would read otherwise is refused before."""

import struct
import time
import zlib
from collections.abc import Callable

import cv2
import msgspec
import numpy as np
import pytest
from keyframes_and_servers import wall

from tsfusion.wire.records import array_encoding, codec
from tsfusion.wire.records.record_header import Refused, pack, unpack

SHAPE = (48, 64)
IMAGE = (np.arange(48 * 64) % 251).astype(np.uint8).reshape(SHAPE)
PNG = cv2.imencode(".png", IMAGE.astype(np.uint16) * 200)[1].tobytes()
JPEG = cv2.imencode(".jpg", np.dstack([IMAGE] * 3))[1].tobytes()
PROGRESSIVE = cv2.imencode(".jpg", np.dstack([IMAGE] * 3), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
RESTARTS = cv2.imencode(".jpg", np.dstack([IMAGE] * 3), [cv2.IMWRITE_JPEG_RST_INTERVAL, 1])[1].tobytes()
SOF = JPEG.index(b"\xff\xc0")


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def with_chunk(kind: bytes, body: bytes, times: int = 1) -> bytes:
    """Behind the PNG's header."""
    return PNG[:33] + chunk(kind, body) * times + PNG[33:]


def with_segment(marker: int, body: bytes) -> bytes:
    """At the JPEG's beginning."""
    return JPEG[:2] + bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body + JPEG[2:]


def two_sizes(marker: bytes) -> bytes:
    """A marker that has no length; who reads one jumps over the frame header that counts, to another."""
    large = bytearray(JPEG[SOF : SOF + 19])
    large[5:9] = struct.pack(">HH", 30_000, 30_000)
    image = JPEG[:2] + marker + bytes(large) + JPEG[2:SOF] + JPEG[SOF + 19 :]
    length = int.from_bytes(large[:2], "big")
    return image.ljust(4 + length, b"\0") + JPEG[SOF : SOF + 19] + b"\xff\xd9"


@pytest.mark.parametrize(
    "image",
    [
        PNG,
        JPEG,
        PROGRESSIVE,
        RESTARTS,
        with_chunk(b"pHYs", bytes(9)),
        with_chunk(b"tEXt", b"Comment\0hello"),
        with_segment(0xE1, b"Exif\0\0" + bytes(20)),
        with_segment(0xE2, b"ICC_PROFILE\0" + bytes(500)),
        with_segment(0xFE, b"hello"),
        PNG + b"and more",
        JPEG + bytes(100),
    ],
    ids=str,
)
def test_what_cameras_write_is_taken(image: bytes) -> None:
    assert array_encoding.image_size(image) == array_encoding.image_size(memoryview(image)) == SHAPE


def header_again() -> bytes:
    return PNG[:8] + chunk(b"IHDX", PNG[16:29]) + PNG[8:]


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (lambda: b"", "neither a PNG nor a JPEG"),
        (lambda: b"GIF89a" + bytes(100), "neither a PNG nor a JPEG"),
        (lambda: PNG[:8] + bytes(24), "a PNG begins with its header"),
        (header_again, "a PNG begins with its header"),
        (lambda: PNG[:33] + struct.pack(">I", 2**31 - 1) + b"IDAT" + PNG[41:], "cut short"),
        (lambda: PNG[:-12], "cut short"),
        (lambda: PNG[:20], "cut short"),
        (lambda: with_chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(7_000_000)), 200), "zTXt"),
        (lambda: with_chunk(b"iTXt", b"k\0\1\0\0\0" + zlib.compress(bytes(7_000_000)), 200), "iTXt"),
        (lambda: with_chunk(b"iCCP", b"k\0\0" + zlib.compress(bytes(1_000))), "iCCP"),
        (lambda: with_chunk(b"acTL", struct.pack(">II", 2, 0)), "acTL"),
        (lambda: with_chunk(b"IHDR", struct.pack(">IIBBBBB", 20_000, 20_000, 16, 0, 0, 0, 0)), "IHDR"),
        (lambda: with_chunk(b"tEXt", b"", 100_000), "too many chunks"),
        (lambda: PNG[:28] + b"\1" + PNG[29:], "interlaced"),
        (lambda: two_sizes(b"\xff\x01"), "marker 01"),
        (lambda: two_sizes(b"\xff\xd0"), "marker d0"),
        (lambda: two_sizes(b"\xff\xd8"), "marker d8"),
        (lambda: JPEG[:2] + b"\xff" + JPEG[2:], "marker ff"),
        (lambda: JPEG[:SOF], "without a frame header"),
        (lambda: JPEG[:SOF] + b"\xff\xda" + JPEG[SOF + 2 :], "marker da"),
        (lambda: JPEG[:2] + b"\xff\xe0\x00\x01" + JPEG[2:], "without a frame header"),
        (lambda: b"\xff\xd8" + b"\xff\xe0\x00\x02" * (4 << 20), "without a frame header"),
        (lambda: PROGRESSIVE[:-2] + PROGRESSIVE[PROGRESSIVE.rindex(b"\xff\xda") :] * 1000, "scans"),
    ],
)
def test_what_would_cost_more_than_it_announces_is_refused(image: Callable[[], bytes], problem: str) -> None:
    with pytest.raises(Refused, match=problem) as refused:
        array_encoding.image_size(image())
    assert refused.value.reason == "payload"


ROWS = b"".join(b"\0" + row.tobytes() for row in (IMAGE.astype(np.uint16) * 200).byteswap())


def with_pixels(*parts: bytes) -> bytes:
    """The PNG with this for its compressed pixels."""
    return PNG[:33] + b"".join(chunk(b"IDAT", part) for part in parts) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "image",
    [
        *(PNG, JPEG, PROGRESSIVE),
        with_pixels(zlib.compress(ROWS)),
        with_pixels(zlib.compress(ROWS, 0)),
        with_pixels(zlib.compress(ROWS)[:100], b"", zlib.compress(ROWS)[100:]),
        *(
            cv2.imencode(".png", np.full(shape, 7, dtype))[1].tobytes()
            for shape in ((1, 1), (33, 7), (5, 6, 3), (5, 6, 4), (700, 900))
            for dtype in (np.uint8, np.uint16)
        ),
    ],
    ids=str,
)
def test_an_image_that_unfolds_to_its_pixels_is_decoded(image: bytes) -> None:
    array_encoding.check_unfolding(image)
    assert cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_UNCHANGED) is not None


def test_no_more_is_unfolded_than_shows_that_it_is_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    unfolded = 0

    class Inflater:
        def __init__(self) -> None:
            self._real = real()

        def decompress(self, content: bytes, most: int) -> bytes:
            nonlocal unfolded
            content = self._real.decompress(content, most)
            unfolded += len(content)
            return content

        def __getattr__(self, name: str) -> object:
            return getattr(self._real, name)

    real = zlib.decompressobj
    monkeypatch.setattr(zlib, "decompressobj", Inflater)
    with pytest.raises(Refused, match="more bytes"):
        array_encoding.check_unfolding(with_pixels(zlib.compress(ROWS + bytes(4_000_000))))
    assert unfolded <= len(ROWS) + 1


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (lambda: with_pixels(zlib.compress(ROWS + bytes(100))), "more bytes than the 6192"),
        (lambda: with_pixels(zlib.compress(ROWS + bytes(400_000_000))), "more bytes than the 6192"),
        (lambda: with_pixels(zlib.compress(ROWS), zlib.compress(bytes(7_000_000))), "data after its pixels"),
        (lambda: with_pixels(zlib.compress(ROWS[:-1])), "fewer bytes"),
        (lambda: with_pixels(zlib.compress(ROWS)[:-30]), "fewer bytes"),
        (lambda: with_pixels(b"nonsense" * 100), "not compressed"),
    ],
)
def test_a_png_that_unfolds_to_more_is_refused_before_it_is_decoded(
    monkeypatch: pytest.MonkeyPatch, image: Callable[[], bytes], problem: str
) -> None:
    monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(Refused, match=problem):
        array_encoding.unpack_image(image(), np.dtype(np.uint16), SHAPE)


def test_a_jpeg_of_a_million_segments_does_not_hold_the_gateway_up() -> None:
    good = codec.encode(wall(), session=bytes(16), seq=1, jpeg_quality=90)
    header = unpack(good[0])
    evil = b"\xff\xd8" + b"\xff\xe0\x00\x02" * (4 << 20)
    color = msgspec.structs.replace(header.buffers[1], bytes=len(evil), crc32=zlib.crc32(evil))
    head = pack(msgspec.structs.replace(header, buffers=(header.buffers[0], color)))
    started = time.process_time()
    with pytest.raises(Refused, match="without a frame header"):
        codec.check([head, good[1], evil])
    assert time.process_time() - started < 0.5  # a millisecond; a loop over the segments takes seconds
