# SPDX-License-Identifier: MIT
"""Corrections as bytes: what survives, what is refused, what a client may say."""

import struct

import msgspec
import numpy as np
import pytest
from hostile_messages import hostile_corrections
from keyframes_and_servers import pose
from repository import GOLDEN

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import InvalidKeyframe
from tsfusion.gateway.intake.keyframe_intake import Quotas
from tsfusion.geometry import se3
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.corrections import Correction, checked
from tsfusion.wire.records.record_header import CorrectionHeader, Refused, is_correction, unpack, with_fields

SESSION = bytes(range(16))


def some(count: int, seed: int = 0, first: int = 1) -> dict[int, np.ndarray]:
    """Draw so many poses without round numbers."""
    rng = np.random.default_rng(seed)
    return {first + i: se3.exp(rng.normal(size=6)) for i in range(count)}


def same(a: Correction, b: Correction) -> bool:
    """To the bit."""
    T = [b"" if one.T_map_odometry is None else one.T_map_odometry.tobytes() for one in (a, b)]
    arrays = [[one.seqs.tobytes(), one.poses.tobytes(), one.removed.tobytes()] for one in (a, b)]
    return arrays[0] == arrays[1] and T[0] == T[1]


def decoded(frames: list[bytes]) -> Correction:
    found = codec.decode(frames)
    assert isinstance(found, Correction)
    return found


@pytest.mark.parametrize("count", [0, 1, 700, 10_000])
def test_corrections_survive_the_wire_to_the_bit(count: int) -> None:
    sent = checked(some(count), T_map_odometry=se3.exp(np.ones(6)), removed=[count + 3, count + 1])
    frames = corrections.encode(sent, session=SESSION, seq=count + 9, map_name="yard")
    assert is_correction(frames[0])
    header = codec.check(frames)
    assert isinstance(header, CorrectionHeader)
    numbers = (header.session, header.seq, header.previous)
    assert (numbers, header.map) == ((SESSION, count + 9, count + 8), "yard")
    assert sent.removed.tolist() == [count + 1, count + 3]
    assert same(decoded(frames), sent)
    assert same(decoded([with_fields(frames[0], previous=2, sent_ns=3), frames[1]]), sent)


def test_the_golden_correction_stays_readable() -> None:
    """As others implement it: a change here is a new version of the record."""
    quarter = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 1 / 3], [0, 0, 0, 1]])
    wanted = checked({2: quarter, 7: pose(1e5, -1e-300)}, T_map_odometry=pose(0.1, 0.2, 0.3), removed=[3, 5])
    stored = (GOLDEN / "correction-v1.bin").read_bytes()
    count, head, body = struct.unpack_from("<BII", stored)
    frames = [stored[9 : 9 + head], stored[9 + head :]]
    assert (count, len(frames[1])) == (2, body)
    assert same(decoded(frames), wanted)
    assert corrections.encode(wanted, session=SESSION, seq=9, previous=7, map_name="yard") == frames


@pytest.mark.parametrize(("name", "reason", "frames"), hostile_corrections(SESSION))
def test_messages_that_are_none_are_refused(name: str, reason: str, frames: list[bytes]) -> None:
    with pytest.raises(Refused) as caught:
        codec.check(frames)
    assert caught.value.reason == reason, name


def test_a_correction_must_fit_into_a_message() -> None:
    frames = corrections.encode(checked(some(100)), session=SESSION, seq=101)
    with pytest.raises(Refused, match="a correction must be at most 5000 bytes, got 10"):
        codec.check(frames, 5000)


def test_a_correction_is_no_keyframe() -> None:
    with pytest.raises(Refused, match="a keyframe is expected, got a correction"):
        codec.decode_keyframe(corrections.encode(checked({}), session=SESSION, seq=1))


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (checked({8: pose(), 9: pose()}), "correction 9 names keyframe 9, which comes after it"),
        (checked({1: pose()}, removed=[12]), "correction 9 names keyframe 12"),
        (checked({1: pose(101)}), "a sensor may be 100 m from the origin, got 101 m"),
    ],
)
def test_the_server_takes_only_what_can_be(sent: Correction, message: str) -> None:
    frames = corrections.encode(sent, session=SESSION, seq=9)
    with pytest.raises(Refused, match=message):
        Quotas(ServerConfig(quota_extent=100.0)).check(codec.check(frames), frames)


def test_poses_are_checked_before_they_are_sent() -> None:
    found = checked({7: pose(1), np.int64(3): np.round(se3.exp(np.ones(6)), 5)})  # type: ignore[dict-item]
    assert found.seqs.tolist() == [3, 7]
    assert np.abs(found.poses[0, :3, :3] @ found.poses[0, :3, :3].T - np.eye(3)).max() < 1e-15  # made exact
    for poses, message in (
        ({0: pose()}, "number is an integer > 0, got 0"),
        ({-1: pose()}, "got -1"),
        ({1 << 63: pose()}, "got 9223372036854775808"),
        ({1.5: pose()}, "got 1.5"),
        ({5: np.diag([1.0, 1, -1, 1])}, "pose of keyframe 5: T_world_camera must hold a rotation"),
        ({1: pose(), 5: pose(np.nan)}, "keyframe 5: T_world_camera must be finite"),
        ({5: pose(2e6)}, "keyframe 5: T_world_camera must translate by at most"),
        ({1: pose(), 5: np.eye(3)}, r"keyframe 5: T_world_camera must have shape \(4, 4\)"),
        ({5: "a pose"}, "keyframe 5: T_world_camera must be a"),
        (dict.fromkeys(range(1, corrections.MAX_KEYFRAMES + 2)), "at most 100000 keyframes"),
    ):
        with pytest.raises(InvalidKeyframe, match=message):
            checked(poses)  # type: ignore[arg-type]
    with pytest.raises(InvalidKeyframe, match="keyframe 2 cannot be both corrected and removed"):
        checked(some(3), removed=[2])
    with pytest.raises(InvalidKeyframe, match="number is an integer > 0, got 0"):
        checked({}, removed=[0])


def test_fields_of_later_minor_versions_are_skipped() -> None:
    frames = corrections.encode(checked(some(2)), session=SESSION, seq=3)
    fields = {**msgspec.msgpack.decode(frames[0][4:]), "loops": 5}
    assert unpack(frames[0][:4] + msgspec.msgpack.encode(fields)) == unpack(frames[0])
