# SPDX-License-Identifier: MIT
"""A sealed message is as it was sent, or is known not to be."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from keyframes_and_servers import wall

from tsfusion.core.errors import DecodeError
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Stamps
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.record_header import is_damaged, seal, unpack, with_fields

SESSION = bytes(range(16))


def flipped(message: bytes) -> Iterator[bytes]:
    """The message with each of its bits flipped, one at a time."""
    for place in range(8 * len(message)):
        worn = bytearray(message)
        worn[place // 8] ^= 1 << place % 8
        yield bytes(worn)


@pytest.mark.parametrize("entries", [0, 1, 14, 15, 16, 17, 300])
def test_a_sealed_map_reads_as_before(entries: int) -> None:
    content = {f"key{number}": number for number in range(entries)}
    sealed = seal(msgspec.msgpack.encode(content))
    read = msgspec.msgpack.decode(sealed)
    assert len(read.pop("check")) == 4
    assert read == content
    assert not is_damaged(sealed)
    assert not is_damaged(msgspec.msgpack.encode(content))


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_damage_to_the_seal_itself_does_not_hide_other_damage(bits: int) -> None:
    """A pose that was no rotation was refused for good, where a bit of the seal had flipped as well."""
    sealed = seal(msgspec.msgpack.encode({"pose": [1.0, 2.0, 3.0], "number": 7}))
    at = sealed.index(b"check") - 1
    random = np.random.default_rng(bits)
    for place in range(at):
        worn = bytearray(sealed)
        worn[place] ^= 1 << random.integers(8)
        for bit in random.choice(8 * len(b".check.."), bits, replace=False):
            worn[at + bit // 8] ^= 1 << bit % 8
        assert is_damaged(worn)


@pytest.mark.parametrize("end", [b"", b"\x01", b"\xa5check", b"\xcb" + bytes(8), b"\xff" * 12, bytes(12)])
def test_a_message_without_a_seal_is_an_older_versions(end: bytes) -> None:
    assert not is_damaged(b"\x81" + end)


def test_random_bytes_are_not_taken_for_a_seal() -> None:
    """The sender of a message that is taken for a damaged one is asked for it again and again."""
    random = np.random.default_rng(0)
    assert not any(
        is_damaged(message.tobytes()) for message in random.integers(0, 256, (200_000, 12), np.uint8)
    )


@pytest.mark.parametrize("kind", ["keyframe", "correction"])
def test_no_flipped_bit_changes_a_header(kind: str) -> None:
    if kind == "keyframe":
        frames = codec.encode(wall(3), session=SESSION, seq=7, jpeg_quality=90)
    else:
        frames = corrections.encode(corrections.checked({1: wall(2).T_world_camera}), session=SESSION, seq=7)
    head = with_fields(frames[0], previous=5, sent_ns=99)
    sent = unpack(head)
    for worn in flipped(head):
        try:
            assert unpack(worn) == sent
        except DecodeError:
            continue


@pytest.mark.parametrize(
    "message",
    [
        messages.Ack(SESSION, 5, 4, (Stamps(5, 1, 2),)),
        messages.Pong("epoch", 1, 2, 3, 5, 4),
        messages.Nack(SESSION, 5, "door", "values", "it will not do"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_no_flipped_bit_changes_what_a_server_says(message: messages.ToClient) -> None:
    for worn in flipped(messages.encode_sealed(message)):
        try:
            assert messages.decode_to_client(worn) == message
        except DecodeError:
            continue
