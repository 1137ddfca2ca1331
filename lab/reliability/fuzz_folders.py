# SPDX-License-Identifier: MIT
"""Recordings whose files are renamed, exchanged, emptied, cut, doubled, of another type, or have other bytes.

A case is a list of changes. It is refused by a named error, or gives frames of the unharmed recording alone,
each at its own pose; else it raises `Broken`. Of other bytes nobody can tell: then any frames will do.
"""

import json
import random
import shutil
from collections.abc import Callable, Sequence
from functools import cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import msgspec
import numpy as np
import rig_recordings
from numpy.typing import NDArray
from rosbag_scenes import COLOR, DEPTH, infos, records
from rosbag_writing import OPTICAL, writing

from lab.reliability.fuzz_targets import Broken, Target, scratch
from tsfusion.core.errors import TsfusionError
from tsfusion.datasets import Dataset, layout_registry, open_dataset
from tsfusion.datasets.dataset import UnreadableRecording
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.trajectory import quaternion

COUNT = 6  # frames
SIZE = (6, 8)
SAME_POSE = 0.01
CAMERA = "5 0 4\n0 5 3\n0 0 1\n"
_CALIBRATION = "P0: 5 0 4 0 0 5 3 0 0 0 1 0\nP1: 5 0 4 -2 0 5 3 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
_HEADER = 300  # bytes
_TEXT = (".txt", ".json", ".csv", ".yaml", ".log")
Poses = dict[bytes, NDArray[np.float64] | None]  # by the digest of what was measured


# --- unharmed folders ---


def _pose(frame: int) -> NDArray[np.float64]:
    return se3.exp(np.array((0.3 * frame, 0.2, 0.1 * frame, 0.02, 0.1 * frame, 0.01)))


def _matrix(T: NDArray[np.float64], *, lines: bool = False) -> str:
    rows = [" ".join(f"{value:.9f}" for value in row) for row in T]
    return ("\n" if lines else " ").join(rows) + "\n"


def _tum_line(frame: int) -> str:
    T = _pose(frame)
    numbers = " ".join(f"{value:.9f}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
    return f"{1000 + frame / 10:.6f} {numbers}\n"


def _put(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def _image(path: Path, frame: int, side: int = 0) -> None:
    """Depth for side 0, else colour or a grey image."""
    rng = np.random.default_rng((frame, side))
    depth = rng.integers(500, 3000, SIZE).astype(np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), rng.integers(0, 256, (*SIZE, 3)).astype(np.uint8) if side else depth)


def _points(path: Path, frame: int, columns: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.abs(np.random.default_rng(frame).normal(size=(50, columns))).astype(np.float32).tofile(path)


def _images(root: Path, depth: str, color: str) -> None:
    for frame in range(COUNT):
        _image(root / depth.format(frame), frame)
        _image(root / color.format(frame), frame, 1)


def _rows(columns: int = 4, frames: Sequence[int] = range(COUNT)) -> str:
    return "".join(_matrix(_pose(frame)[:columns]) for frame in frames)


def _tum(root: Path) -> None:
    for frame in range(COUNT):
        for side, name in enumerate(("depth", "rgb")):
            _image(root / name / f"{1000 + frame / 10:.6f}.png", frame, side)
    for name in ("depth", "rgb"):
        stamps = [f"{1000 + frame / 10:.6f}" for frame in range(COUNT)]
        _put(root / f"{name}.txt", "".join(f"{stamp} {name}/{stamp}.png\n" for stamp in stamps))
    _put(root / "groundtruth.txt", "".join(map(_tum_line, range(COUNT))))
    _put(root / "K.txt", CAMERA)


def _seven_scenes(root: Path) -> None:
    _images(root, "frame-{:06d}.depth.png", "frame-{:06d}.color.png")
    for frame in range(COUNT):
        _put(root / f"frame-{frame:06d}.pose.txt", _matrix(_pose(frame), lines=True))
    _put(root / "camera-intrinsics.txt", CAMERA)


def _scannet(root: Path) -> None:
    _images(root, "depth/{}.png", "color/{}.jpg")
    for frame in range(COUNT):
        _put(root / "pose" / f"{frame}.txt", _matrix(_pose(frame), lines=True))
    for camera in ("depth", "color"):
        _put(root / "intrinsic" / f"intrinsic_{camera}.txt", "5 0 4 0\n0 5 3 0\n0 0 1 0\n0 0 0 1\n")


def _replica(root: Path) -> None:
    _images(root, "results/depth{:06d}.png", "results/frame{:06d}.jpg")
    _put(root / "traj.txt", _rows())
    camera = {"w": SIZE[1], "h": SIZE[0], "fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0, "scale": 6553.5}
    _put(root / "cam_params.json", json.dumps({"camera": camera}))


def _nerfstudio(root: Path) -> None:
    _images(root, "depth/{:04d}.png", "images/{:04d}.png")
    frames = [
        {"file_path": f"images/{frame:04d}.png", "depth_file_path": f"depth/{frame:04d}.png",
         "transform_matrix": _pose(frame).tolist()}
        for frame in range(COUNT)
    ]  # fmt: skip
    camera = {"fl_x": 5.0, "fl_y": 5.0, "cx": 4.5, "cy": 3.5, "w": SIZE[1], "h": SIZE[0]}
    _put(root / "transforms.json", json.dumps({**camera, "camera_model": "PINHOLE", "frames": frames}))


def _hololens(root: Path) -> None:
    _images(root, "depth/{:05d}.png", "images/{:05d}.png")
    _put(root / "K.txt", CAMERA)
    _put(root / "poses.txt", _rows())


def _redwood(root: Path) -> None:
    _images(root, "depth/{:05d}.png", "color/{:05d}.png")
    _put(root / "camera-intrinsics.txt", CAMERA)
    poses = (f"{f} {f} {f + 1}\n" + _matrix(_pose(f), lines=True) for f in range(COUNT))
    _put(root / "trajectory.log", "".join(poses))


def _plain(root: Path) -> None:
    _images(root, "depth/{:05d}.png", "rgb/{:05d}.png")
    _put(root / "K.txt", CAMERA)


def _flat(root: Path) -> None:
    _images(root, "depth_{:06d}.png", "color_{:06d}.png")
    _put(root / "K.txt", CAMERA)


def _stereo(root: Path) -> None:
    for frame in range(COUNT):
        for side, name in enumerate(("left", "right"), 1):
            _image(root / name / f"{frame:06d}.png", frame, side)
    _put(root / "K.txt", CAMERA)
    _put(root / "baseline.txt", "0.12\n")


_GL = np.diag([1.0, -1, -1, 1])  # OpenGL's axes of a camera
_PIXELS = {"fx": 5.0, "fy": 5.0, "cx": 4.0, "cy": 3.0}


def _record3d(root: Path) -> None:
    _images(root, "depth/{}.png", "rgb/{}.png")
    poses = [[*quaternion((_pose(f) @ _GL)[:3, :3]), *_pose(f)[:3, 3]] for f in range(COUNT)]
    said = {"w": SIZE[1], "h": SIZE[0], "dw": SIZE[1], "dh": SIZE[0], "K": [5.0, 0, 0, 0, 5, 0, 4, 3, 1],
            "poses": poses, "frameTimestamps": [f / 10 for f in range(COUNT)]}  # fmt: skip
    _put(root / "metadata.json", json.dumps(said))


def _stray(root: Path) -> None:
    _images(root, "depth/{:06d}.png", "rgb/{:06d}.png")
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for frame in range(COUNT):
        cv2.imwrite(str(_made(root / "confidence") / f"{frame:06d}.png"), np.full(SIZE, 2, np.uint8))
        T = _pose(frame)
        values = ", ".join(f"{value:.9f}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
        lines.append(f"{100 + frame / 10:.6f}, {frame:06d}, {values}")
    _put(root / "odometry.csv", "\n".join(lines) + "\n")
    _put(root / "camera_matrix.csv", "5.0, 0.0, 4.0\n0.0, 5.0, 3.0\n0.0, 0.0, 1.0\n")


def _polycam(root: Path) -> None:
    _images(root, "keyframes/depth/{:06d}00000.png", "keyframes/images/{:06d}00000.png")
    for frame in range(COUNT):
        T = _pose(frame) @ _GL
        rows = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        said = {**_PIXELS, "width": SIZE[1], "height": SIZE[0], **rows}
        _put(root / f"keyframes/cameras/{frame:06d}00000.json", json.dumps(said))


def _scanner_app(root: Path) -> None:
    _images(root, "depth_{:05d}.png", "frame_{:05d}.png")
    for frame in range(COUNT):
        said = {"intrinsics": [5.0, 0, 4, 0, 5, 3, 0, 0, 1], "time": frame / 10,
                "cameraPoseARFrame": (_pose(frame) @ _GL).ravel().tolist()}  # fmt: skip
        _put(root / f"frame_{frame:05d}.json", json.dumps(said))


def _arkit_scenes(root: Path) -> None:
    lines = []
    for frame in range(COUNT):
        name = f"4106_{300 + frame / 10:.3f}"
        _image(root / f"lowres_depth/{name}.png", frame)
        _image(root / f"lowres_wide/{name}.png", frame, 1)
        _put(root / f"lowres_wide_intrinsics/{name}.pincam", f"{SIZE[1]} {SIZE[0]} 5 5 4 3\n")
        T = se3.inverse(_pose(frame))
        values = (*cv2.Rodrigues(T[:3, :3])[0].ravel(), *T[:3, 3])
        lines.append(f"{300 + frame / 10:.3f} " + " ".join(f"{value:.9f}" for value in values))
    _put(root / "lowres_wide.traj", "\n".join(lines) + "\n")


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _kitti(root: Path) -> None:
    place = root / "sequences" / "06"
    for frame in range(COUNT):
        for side in (0, 1):
            _image(place / f"image_{side}" / f"{frame:06d}.png", frame, side + 1)
        _points(place / "velodyne" / f"{frame:06d}.bin", frame, 4)
    _put(place / "calib.txt", _CALIBRATION)
    _put(place / "times.txt", "".join(f"{frame / 10:e}\n" for frame in range(COUNT)))
    _put(root / "poses" / "06.txt", _rows(3))


def _scans(root: Path) -> None:
    for frame in range(COUNT):
        _points(root / f"{frame:06d}.bin", frame, 4)
    _put(root / "poses_kitti.txt", _rows(3))


def _lidar_keyframes(root: Path) -> None:
    lines = []
    for frame in range(COUNT):
        _points(root / f"{frame:06d}" / "points.bin", frame, 3)
        lines.append(f"v{frame} " + _tum_line(frame).split(" ", 1)[1])
    _put(root / "graph.txt", "".join(lines))


def _clouds(suffix: str, root: Path) -> None:
    """Scans named by their times, as text and as numbers, packed ones too; and poses by time."""
    for frame in range(COUNT):
        points = np.abs(np.random.default_rng(frame).normal(size=(50, 4))).astype(np.float32)
        _CLOUDS[suffix](root / f"{1000 + frame / 10:.6f}.{suffix}", points, frame)
    _put(root / "poses_tum.txt", "".join(map(_tum_line, range(COUNT))))


def _pcd(path: Path, points: NDArray[np.float32], frame: int) -> None:
    from pypcd4.pypcd4 import Encoding, PointCloud

    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = (Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED)
    PointCloud.from_xyzi_points(points).save(path, kinds[frame % len(kinds)])


def _ply(path: Path, points: NDArray[np.float32], frame: int) -> None:
    fields = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    kind = ("ascii", "binary_little_endian")[frame % 2]
    _put(path, f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n{fields}end_header\n")
    with path.open("ab") as file:
        np.savetxt(file, points) if kind == "ascii" else file.write(points.tobytes())


def _las(path: Path, points: NDArray[np.float32], frame: int) -> None:
    import laspy

    path.parent.mkdir(parents=True, exist_ok=True)
    las = laspy.create(point_format=1 + 5 * (frame % 2), file_version="1.4")
    las.xyz, las.gps_time = points[:, :3], np.linspace(0, 0.1, len(points))
    las.write(path)


_CLOUDS = {"pcd": _pcd, "ply": _ply, "las": _las, "laz": _las}


def _bag(form: str, root: Path) -> None:
    """Depth with colour, or a LiDAR's points, and transforms; no message is in another's chunk."""
    root.mkdir(parents=True, exist_ok=True)
    camera = Intrinsics(5.0, 5.0, 4.0, 3.0)
    with writing(root, form) as (bag, _):
        for frame in range(COUNT):
            stamp, rng = 1000 * 10**9 + frame * 10**8, np.random.default_rng((frame, 0))
            bag.transform(_pose(frame), "map", OPTICAL, stamp)
            if form.startswith("mcap"):
                points = np.abs(rng.normal(size=(50, 3))).astype(np.float32)
                bag.cloud("/points", records(x=points[:, 0], y=points[:, 1], z=points[:, 2]), stamp, OPTICAL)
                continue
            infos(bag, stamp, SIZE, camera)
            bag.image(DEPTH, rng.integers(500, 3000, SIZE).astype(np.uint16), "16UC1", stamp)
            bag.image(COLOR, rng.integers(0, 256, (*SIZE, 3)).astype(np.uint8), "rgb8", stamp)


WRITERS: dict[str, Callable[[Path], object]] = {
    **{f"bag-{form}": partial(_bag, form) for form in ("ros1", "ros1-lz4", "sqlite3", "mcap", "mcap-zstd")},
    "arkit-scenes": _arkit_scenes,
    "euroc": partial(rig_recordings.euroc, count=3),
    "flat": _flat,
    "hololens": _hololens,
    "kitti": _kitti,
    "kitti-raw": partial(rig_recordings.kitti_raw, count=3),
    "lidar-keyframes": _lidar_keyframes,
    "nerfstudio": _nerfstudio,
    "plain": _plain,
    "polycam": _polycam,
    "record3d": _record3d,
    "redwood": _redwood,
    "replica": _replica,
    "scanner-app": _scanner_app,
    "scannet": _scannet,
    "scans": _scans,
    **{f"scans-{suffix}": partial(_clouds, suffix) for suffix in _CLOUDS},
    "seven-scenes": _seven_scenes,
    "stereo": _stereo,
    "stray": _stray,
    "tum": _tum,
}


# --- changes ---


def _rename(root: Path, one: Path, other: Path, number: int) -> None:
    one.rename(one.with_name(f"x{number % 100}-{one.name}"))


def _exchange(root: Path, one: Path, other: Path, number: int) -> None:
    unharmed = [root.with_name("whole") / file.relative_to(root) for file in (one, other)]
    were_alike = all(map(Path.is_file, unharmed)) and _kind(unharmed[0]) == _kind(unharmed[1])
    if _kind(one) != _kind(other) and not were_alike:  # else nobody could tell
        content = one.read_bytes()
        one.write_bytes(other.read_bytes())
        other.write_bytes(content)


def _kind(file: Path) -> tuple[str, ...]:
    """What files have in common of which nobody can tell one from the other by what they hold."""
    content = file.read_bytes()
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    if image is not None:
        return str(image.dtype), str(image.ndim)
    if b"\0" in content or file.suffix[1:] in _CLOUDS:  # points
        return ("numbers",)
    return file.suffix, "".join(letter for letter in file.stem if letter.isalpha())


def _cut(root: Path, one: Path, other: Path, number: int) -> None:
    """Cut a file: one of points within a number, one of text between two, as nobody can tell else."""
    content = one.read_bytes()
    end = number % max(len(content), 1) | 1
    if one.suffix in _TEXT:
        while end > 0 and content[end - 1 : end] not in (b" ", b"\n", b",", b""):
            end -= 1
    one.write_bytes(content[:end])


def _of_another_type(root: Path, one: Path, other: Path, number: int) -> None:
    if one.suffix == ".png":
        cv2.imwrite(str(one.with_suffix(".jpg")), np.zeros((*SIZE, 3), np.uint8))
    else:
        one.write_bytes(b"\xff\xd8\xff\xe0" + bytes(50))


def _all(root: Path, one: Path, other: Path, number: int) -> None:
    """Rename or remove a kind of file."""
    for file in [each for each in one.parent.iterdir() if each.suffix == one.suffix]:
        if number % 2:
            file.unlink()
        else:
            file.rename(file.with_suffix(".jpg"))


def _exchange_folders(root: Path, one: Path, other: Path, number: int) -> None:
    places = sorted(
        place for place in one.parent.parent.iterdir() if place.is_dir() and not place.name.isdigit()
    )
    kinds = [{_kind(file) for file in place.glob("*.*")} for place in places[:2]]
    if root in one.parent.parents and len(places) > 1 and kinds[0].isdisjoint(kinds[1]):
        aside = one.parent.parent / "aside"
        places[0].rename(aside)
        places[1].rename(places[0])
        aside.rename(places[1])


def _other_bytes(root: Path, one: Path, other: Path, number: int) -> None:
    """Change bytes of a file, half of them near its start, where headers are."""
    content, rng = bytearray(one.read_bytes()), random.Random(number)
    for _ in range(1 << rng.randrange(5) if content else 0):
        content[rng.randrange(rng.choice((len(content), min(len(content), _HEADER))))] = rng.randrange(256)
    one.write_bytes(content)


_CHANGES: tuple[Callable[[Path, Path, Path, int], object], ...] = (
    _rename,
    _exchange,
    lambda root, one, other, number: one.write_bytes(b""),
    _cut,
    lambda root, one, other, number: shutil.copy(one, one.with_name(f"{one.stem} copy{one.suffix}")),
    _of_another_type,
    lambda root, one, other, number: one.unlink(),
    lambda root, one, other, number: one.write_text("not what it was"),
    _all,
    _exchange_folders,
    _other_bytes,
)


def _seeds() -> list[bytes]:
    return [msgspec.msgpack.encode([[kind, 0, 1, 2]]) for kind in range(len(_CHANGES))]


def _mutate(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """Another file, another change, or one more."""
    changes = msgspec.msgpack.decode(content)[:1] if rng.random() < 0.5 else []
    changes.append([rng.randrange(len(_CHANGES)), *(rng.randrange(1 << 16) for _ in range(3))])
    return msgspec.msgpack.encode(changes)


# --- a case ---


def _digest(frame: Frame) -> bytes:
    measured = [frame.depth, frame.left, frame.right, frame.points]
    found = b"".join(np.ascontiguousarray(one).tobytes() for one in measured if one is not None)
    return blake2b(found, digest_size=16).digest()


def _frames(dataset: Dataset) -> Poses:
    found: Poses = {}
    for index in range(len(dataset)):
        try:
            frame = dataset.frame(index)  # type: ignore[attr-defined]
        except UnreadableRecording:
            raise
        except TsfusionError:
            continue
        found[_digest(frame)] = frame.T_world_camera
    return found


@cache
def _whole(layout: str) -> tuple[Path, Poses]:
    """The unharmed folder, and its frames."""
    root = scratch() / layout / "whole"
    root.mkdir(parents=True)
    WRITERS[layout](root)
    frames = _frames(open_dataset(root, posed=False))
    if layout == "kitti":
        frames |= _frames(open_dataset(root, posed=False, modality="lidar"))
    if len(frames) < 3:
        raise Broken(f"{layout}: the whole folder has {len(frames)} frames")
    return root, frames


def run(layout: str, content: bytes) -> str:
    """Harm a copy of the folder, and open it with its poses, without them, and with those of another file."""
    whole, frames = _whole(layout)
    wanted: Poses | None = frames
    work = whole.with_name("work")
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(whole, work)
    for kind, one, other, number in msgspec.msgpack.decode(content):
        files = sorted(path for path in work.rglob("*") if path.is_file())
        change = _CHANGES[kind % len(_CHANGES)]
        wanted = None if change is _other_bytes else wanted
        if files:
            change(work, files[one % len(files)], files[other % len(files)], number)
    trajectory = whole.with_name("slam.txt")
    _put(trajectory, "".join(map(_tum_line, range(COUNT))))
    options: tuple[dict[str, object], ...] = ({}, {"posed": False}, {"trajectory": trajectory})
    with mock.patch.object(layout_registry, "_plugins", list):  # looking for them takes longer than the rest
        return "; ".join(_opened(work, wanted, **each) for each in options)


def _opened(root: Path, wanted: Poses | None, **options: Any) -> str:
    try:
        dataset = open_dataset(root, **options)
        found = _frames(dataset)
    except TsfusionError as error:
        if "\n" in str(error):
            raise Broken(f"not one line: {error}") from error
        return type(error).__name__
    shift = None
    for digest, T in found.items() if wanted is not None else ():
        assert wanted is not None
        if digest not in wanted:
            raise Broken(f"a frame of {dataset.name} is none of the recording, {options}")
        good = wanted[digest]
        if T is not None and good is not None and "KITTI raw" in dataset.name:
            shift = good[:3, 3] - T[:3, 3] if shift is None else shift  # its first packet is the origin
            T[:3, 3] += shift
        if T is not None and "trajectory" not in options and (
            good is None or np.abs(T - good).max() > SAME_POSE
        ):  # fmt: skip
            raise Broken(f"a frame of {dataset.name} is at another's pose, {options}")
    return f"{len(found)} of {COUNT}, {sum(T is not None for T in found.values())} posed"


FOLDERS = {
    f"folder-{layout}": Target(seeds=_seeds, run=partial(run, layout), mutate=_mutate, slow_s=10.0)
    for layout in WRITERS
}
