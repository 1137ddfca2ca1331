# SPDX-License-Identifier: MIT
"""Code that strangers' bytes and damaged files reach, as functions of bytes; only named errors come out.

A case that is wrong in another way raises `Broken`.
"""

import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from msgspec import Struct

from lab.reliability import fuzz_mutate
from tsfusion import Keyframe, journal
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import CheckpointError, DecodeError, InvalidKeyframe, JournalError
from tsfusion.gateway.intake.keyframe_intake import Quotas
from tsfusion.geometry import map_questions, se3
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth, MeshLayout, Spread
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.codec import measurement
from tsfusion.wire.records.record_header import CorrectionHeader, Refused, unpack, with_fields

MAX_BYTES = 1 << 16  # of a case


class Broken(AssertionError):
    """A promise that was not kept."""


class Target(Struct, frozen=True):
    """Something to fuzz.

    Attributes:
        seeds: where mutations start.
        run: a case; what came of it, in a word.
        mutate: keeps the form.
        slow_s: processor time that no case may take.
    """

    seeds: Callable[[], list[bytes]]
    run: Callable[[bytes], str]
    mutate: fuzz_mutate.Mutate
    slow_s: float = 1.0


# --- keyframe messages ---


def _keyframes() -> list[Keyframe]:
    rng = np.random.default_rng(0)
    image, points = (6, 8), rng.normal(size=(20, 3)).astype(np.float32)
    camera: dict[str, Any] = {"intrinsics": CAMERA, "T_world_camera": pose(1.0)}
    depth = rng.integers(0, 5000, image).astype(np.uint16)
    color = rng.integers(0, 256, (*image, 3)).astype(np.uint8)
    mask = rng.integers(0, 256, image).astype(np.uint8)
    return [
        wall(),
        Keyframe(depth=depth, color=color, confidence=mask, timestamp_ns=1, captured_ns=2, **camera),
        Keyframe(depth=depth.astype(np.float32) / 1000, sensor="tof", baseline_fx=40.0, **camera),
        Keyframe(disparity=depth, disparity_scale=1 / 16, baseline_fx=50.0, **camera),
        Keyframe(points=points, T_world_camera=pose()),
        Keyframe(
            points=np.round(points, 3).astype(np.float32),
            origins=np.zeros((20, 3), np.float32),
            color=rng.integers(0, 256, (20, 3)).astype(np.uint8),
            confidence=np.full(20, 9, np.uint8),
            T_world_camera=pose(),
        ),
    ]


def _message_seeds() -> list[bytes]:
    import cv2

    found = [
        codec.encode(one, session=bytes(16), seq=i + 1, jpeg_quality=90) for i, one in enumerate(_keyframes())
    ]
    depth = np.arange(SHAPE[0] * SHAPE[1], dtype=np.uint16).reshape(SHAPE)
    png = cv2.imencode(".png", depth)[1].tobytes()
    header = msgspec.msgpack.decode(found[0][0][4:])
    header["buffers"] = [{**header["buffers"][0], "codec": "png"}]
    found.append(fuzz_mutate.repaired([b"TSF\x01" + msgspec.msgpack.encode(header), png]))
    return [fuzz_mutate.join(one) for one in found]


_QUOTAS = Quotas(ServerConfig())


def run_message(content: bytes) -> str:
    """The door, and for what passes it the fuser's decoder."""
    frames = fuzz_mutate.split(content)
    try:
        header = codec.check(frames)
        _QUOTAS.check(header, frames)
    except Refused as error:
        return f"refused {error.reason} {error}"
    if isinstance(header, CorrectionHeader):
        return _run_correction(header, frames)
    try:
        keyframe = codec.decode_keyframe(frames)
    except (DecodeError, InvalidKeyframe) as error:
        return f"{type(error).__name__} {error}"
    if keyframe.kind != measurement(header):
        raise Broken(f"a {measurement(header)} came out as {keyframe.kind}")
    again = unpack(with_fields(frames[0], previous=1, sent_ns=2))
    if (again.previous, again.sent_ns, again.seq) != (1, 2, header.seq):
        raise Broken("the header did not survive its stamp")
    return f"good {keyframe.kind}"


# --- control messages ---

_POINT = np.zeros(3, "<f4").data.cast("B")  # that comes with a question


def _control_seeds() -> list[bytes]:
    session = bytes(range(16))
    spread = Spread()
    health = Health(
        ready=True, problems=("x",), epoch="e", uptime_s=1.0, rss_bytes=1, refused={"gap": 1}, duplicates=0,
        maps={"default": MapHealth(
            state="idle", problem="", keyframes_durable=1, keyframes_fused=1, waiting=0, rejected={},
            quarantined=0, sessions=1, journal_bytes=1, journal_damaged=0, fuser_restarts=0, blocks=1,
            map_bytes=1,
            last_keyframe_s=None, delay_ms=spread, delay_bound_ms=0.1)},
        clients=(ClientHealth(
            client="c", session="00", map="default", heard_s=0.1, durable=1, fused=1, received_bytes=1,
            waiting=0, skipped={"thin": 1}, held=""),),
    )  # fmt: skip
    layout = MeshLayout(vertices=1, faces=1, colors=True)
    said = [
        messages.Hello(session, 1, "room"),
        messages.Ping(session, 1, -5, 7, 3, {"thin": 2}),
        messages.Command(name="mesh", min_weight=0.5),
        *(
            messages.Command(name="ask", question=one, number=7, timeout_s=0.5, compress=True)
            for one in _questions()
        ),
        messages.Welcome("e", 1, 2, 1, 8, 1 << 24, 1 << 25),
        messages.Ack(session, 2, 1, (messages.Stamps(2, 3, 4), messages.Stamps(1)), True),
        messages.Nack(session, 3, "door", "size", "too large"),
        messages.Hold(session, 1.5, "disk", "full"),
        messages.Denied(session, "map", "no"),
        messages.Pong("e", 1, 2, 3, 4, 5),
        messages.Reply(name="health", health=health),
        messages.Reply(name="mesh", mesh=layout),
        messages.Reply(
            name="ask",
            number=7,
            answer=questions.Answer(
                arrays=(questions.ArrayLayout("distance", "float32", (3,), True),),
                crc=5,
                waited_s=0.1,
                state=questions.MapVersion(keyframes=3, changes=4, epoch="e", segment=1, offset=9),
            ),
        ),
    ]
    return [messages.encode(one) for one in said]


def _questions() -> list[questions.Question]:
    pose = tuple(np.eye(4).ravel().tolist())
    return [
        map_questions.Sample(points=1, crc=map_questions.crc_of([_POINT]), min_weight=0.5, surface="raw"),
        map_questions.Raycast(intrinsics=(1.0, 1.0, 0.0, 0.0), pose=pose, shape=(2, 3)),
        map_questions.Slice(
            kind="distance", low=0.0, high=1.0, up=(0.0, 0.0, 1.0), box=(0.0, 0.0, 1.0, 1.0), resolution=0.1
        ),
        map_questions.Field(box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), max_distance=0.5),
        questions.Cells(since=7, epoch="a", wait_s=0.5),
        questions.Scans(since=7, epoch="a", wait_s=0.5),
        questions.Keyframes(session=bytes(range(16)), after=5),
    ]


def run_control(content: bytes) -> str:
    """Both ends' decoders; what they accept can be said again. Questions are checked as a gateway does."""
    outcomes = []
    for decode in (messages.decode_to_server, messages.decode_to_client):
        try:
            message = decode(content)
        except DecodeError as error:
            outcomes.append(str(error)[:80])
            continue
        outcomes.append(type(message).__name__)
        if isinstance(message, messages.Command) and message.question is not None:
            outcomes.append(message.question.problem([_POINT])[:80])
        if isinstance(message, messages.Reply) and message.answer is not None:
            with suppress(DecodeError):
                questions.unpack(message.answer, [_POINT])
        if type(decode(messages.encode(message))) is not type(message):
            raise Broken(f"{message!r} is not what it says")
    return " | ".join(outcomes)


# --- journal segments ---

_scratch: list[tempfile.TemporaryDirectory[str]] = []


def scratch() -> Path:
    """A folder of this process."""
    if not _scratch:
        _scratch.append(tempfile.TemporaryDirectory(prefix="tsfusion-fuzz-"))
    return Path(_scratch[0].name)


def _segment_seeds() -> list[bytes]:
    found = []
    for count, closed in ((3, True), (3, False), (1, True), (0, False)):
        with tempfile.TemporaryDirectory() as folder:
            log = journal.Journal(folder, 1 << 20, sync=False)
            for i in range(count):
                frames = [bytes([i]) * (30 + 40 * i), b"x" * i]
                log.append(frames, session=bytes([i % 2]) * 16, seq=i + 1, client="robot" * (i % 2))
            if closed:
                log.close()
            paths = sorted(Path(folder).glob("*.mcap"))
            found += [path.read_bytes() for path in paths]
            log.close()
    return found


def run_journal(content: bytes) -> str:
    """Every way in which a segment is read, and going on behind it."""
    folder = scratch() / "journal"
    folder.mkdir(exist_ok=True)
    path = journal.segment_path(folder, 1)
    path.write_bytes(content)
    try:
        steps = list(journal.scan_records(path))
        found, lost = journal.list_records(path)
    except JournalError as error:
        return f"JournalError {error}"
    whole = [one for one in steps if isinstance(one, journal.Record)]
    damages = [one for one in steps if isinstance(one, journal.Damage)]
    if lost != sum(one.lost for one in damages):
        raise Broken(f"{lost} keyframes are lost, or {damages}")
    if [(one.position, one.session, one.seq) for one in found] != [
        (r.position, r.session, r.seq) for r in whole
    ]:
        raise Broken("scan and records differ")
    for record in whole:
        again = journal.read_at(path, record.position.offset)
        if [bytes(one) for one in again.frames] != [bytes(one) for one in record.frames]:
            raise Broken(f"another record is read at {record.position}")
    if len(content) % 16 == 0:
        _go_on(folder, len(whole))
    return f"{len(whole)} whole; " + "; ".join(one.what for one in damages)


def _go_on(folder: Path, count: int) -> None:
    log = journal.Journal(folder, 1 << 20, sync=False)
    if len(log.found) != count:
        raise Broken(f"a journal opens with {len(log.found)} of {count} records")
    position = log.append([b"head", b"body"], session=bytes(16), seq=99)
    log.close()
    if [bytes(one) for one in journal.read(folder, position).frames] != [b"head", b"body"]:
        raise Broken("what is written behind it cannot be read")
    journal.segment_path(folder, position.segment).unlink()


# --- saved maps ---


def _checkpoint_seeds() -> list[bytes]:
    path = scratch() / "seed.tsf"
    found = []
    for blocks in (0, 1, 3):
        layers = {"sums": np.arange(blocks * 512, dtype=np.int64).reshape(blocks, 512)}
        header = checkpoint.CheckpointHeader(
            config=VolumeConfig(), keyframes=1, map_hash="00", layers=["sums"], meta={"done": {}}
        )
        keys = np.arange(blocks, dtype=np.int64)
        checkpoint.write(path, header, keys, np.arange(blocks), layers)
        found.append(path.read_bytes())
    return found


def run_checkpoint(content: bytes) -> str:
    """Reading a saved map."""
    path = scratch() / "map.tsf"
    path.write_bytes(content)
    try:
        with checkpoint.reading(path) as (header, chunks):
            blocks = sum(_read_chunk(chunk, header.layers) for chunk in chunks)
    except CheckpointError as error:
        return f"CheckpointError {str(error).replace(str(path), '')}"
    if blocks != header.blocks:
        raise Broken("blocks without keys")
    return "good"


def _read_chunk(chunk: checkpoint.Chunk, layers: list[str]) -> int:
    chunk.fill(np.empty(chunk.blocks, np.int64))
    for name in layers:
        chunk.fill(np.empty((chunk.blocks, 512), LAYER_DTYPES[name]))
    return chunk.blocks


# --- corrections ---


def _correction_seeds() -> list[bytes]:
    rng = np.random.default_rng(0)
    found = []
    for count, removed in ((0, []), (1, [2]), (20, [2, 3, 200])):
        poses = {1 + 3 * i: se3.exp(rng.normal(size=6)) for i in range(count)}
        correction = corrections.checked(poses, T_map_odometry=pose(1.0), removed=removed)
        found.append(fuzz_mutate.join(corrections.encode(correction, session=bytes(16), seq=300)))
    return found


def _run_correction(header: CorrectionHeader, frames: list[bytes]) -> str:
    """Check that an accepted message is as good as one that a client would send."""
    one = corrections.unpack(header, frames[1])
    poses = dict(zip(one.seqs.tolist(), one.poses, strict=True))
    again = corrections.checked(poses, T_map_odometry=one.T_map_odometry, removed=one.removed.tolist())
    sent = corrections.encode(
        again, session=header.session, seq=header.seq, previous=header.previous, map_name=header.map
    )
    if bytes(frames[1]) != sent[1]:
        raise Broken("a client would not have sent it so")
    if msgspec.structs.replace(header, sent_ns=0) != unpack(sent[0]):
        raise Broken("it is not said again as it was")
    return f"good {min(header.count, 3)} {header.removed} {header.T_map_odometry is None}"


TARGETS: dict[str, Target] = {
    "message": Target(_message_seeds, run_message, fuzz_mutate.message),
    "control": Target(_control_seeds, run_control, fuzz_mutate.msgpack),
    "corrections": Target(_correction_seeds, run_message, fuzz_mutate.message),
    "journal": Target(_segment_seeds, run_journal, fuzz_mutate.mcap),
    "checkpoint": Target(_checkpoint_seeds, run_checkpoint, fuzz_mutate.checkpoint),
}
