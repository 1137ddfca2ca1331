# SPDX-License-Identifier: MIT
"""Recordings of phones: real frames in the layout of each app give the same keyframes; damage is named."""

import json
import re
import struct
import zipfile
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from known_turns import BIAS, R_SENSOR_IMU, assert_known, samples
from numpy.typing import NDArray
from small_recordings import one_line

from tsfusion import Volume
from tsfusion.datasets import describe, find, open_dataset
from tsfusion.datasets.formats import phones
from tsfusion.geometry import se3
from tsfusion.geometry.trajectory import quaternion

GL = np.diag([1.0, -1, -1, 1])
KINDS = {"r3d": "Record3D", "export": "Record3D", "stray": "Stray Scanner", "stray-old": "Stray Scanner",
         "polycam": "Polycam", "polycam-corrected": "Polycam", "app": "3D Scanner App",
         "arkit": "ARKitScenes"}  # fmt: skip


class Taken(NamedTuple):
    """A frame of a phone: depth in mm, and colour of another size with its camera."""

    depth: NDArray[np.uint16]
    color: NDArray[np.uint8]
    K: tuple[float, float, float, float]  # of the colour image
    T: NDArray[np.float64]


def drawn(count: int = 4) -> list[Taken]:
    """Frames without a scene, depth 24×32 and colour 96×128."""
    rng = np.random.default_rng(1)
    frames = []
    for index in range(count):
        depth = (1000 + 40 * index + np.arange(24 * 32).reshape(24, 32)).astype(np.uint16)
        color = cv2.resize(rng.integers(0, 255, (6, 8, 3)).astype(np.uint8), (128, 96))
        T = se3.exp(np.array((0.1 * index, 0.02, 0.03, 0.01, 0.05 * index, 0.02)))
        frames.append(Taken(depth, color, (110.0, 110.0, 63.5, 47.5), T))
    return frames


@pytest.fixture(scope="module")
def real(data: Callable[[str], Path]) -> list[Taken]:
    """Every 4th frame of a real recording."""
    pytest.importorskip("OpenEXR")
    dataset = open_dataset(data("record3d_export"))
    said = json.loads((data("record3d_export") / "metadata.json").read_text())
    frames = []
    for index in range(0, len(dataset), 4):
        frame = dataset[index]
        image = cv2.imread(
            str(data("record3d_export") / f"rgb/{index}.jpg"), cv2.IMREAD_IGNORE_ORIENTATION | 1
        )
        K = (np.array(said["perFrameIntrinsicCoeffs"][index])[[0, 1, 2, 3]] / 2 - (0, 0, 0.25, 0.25)).tolist()
        depth = np.rint(1000 * np.nan_to_num(frame.depth)).astype(np.uint16)
        frames.append(Taken(depth, cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), K,
                            frame.T_world_camera))  # fmt: skip
    return frames


def image(path: Path, pixels: NDArray[np.generic]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    good, packed = cv2.imencode(path.suffix, pixels)
    assert good
    path.write_bytes(packed.tobytes())


def levels(frame: Taken, low: int, *others: int) -> NDArray[np.uint8]:
    """Confidence: low in the upper two rows, else medium or high."""
    found = np.resize(np.array(others, np.uint8), frame.depth.shape)
    found[:2] = low
    return found


def metadata(frames: list[Taken]) -> dict[str, object]:
    (h, w), (dh, dw) = frames[0].color.shape[:2], frames[0].depth.shape
    poses = [[*quaternion((frame.T @ GL)[:3, :3]), *frame.T[:3, 3]] for frame in frames]
    fx, fy, cx, cy = frames[0].K
    return {"w": w, "h": h, "dw": dw, "dh": dh, "fps": 60, "poses": poses,
            "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
            "perFrameIntrinsicCoeffs": [[*frame.K] for frame in frames], "initPose": [0, 0, 0, 1, 0, 0, 0],
            "frameTimestamps": [index / 15 for index in range(len(frames))]}  # fmt: skip


def r3d(root: Path, frames: list[Taken], **changed: object) -> Path:
    lzfse = pytest.importorskip("lzfse")
    root.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(root / "房间.r3d", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("metadata", json.dumps({**metadata(frames), **changed}))
        for index, frame in enumerate(frames):
            depth = (frame.depth * np.float32(0.001)).astype("<f4")
            packed.writestr(f"rgbd/{index}.depth", lzfse.compress(depth.tobytes()))
            packed.writestr(f"rgbd/{index}.conf", lzfse.compress(levels(frame, 0, 2).tobytes()))
            packed.writestr(f"rgbd/{index}.jpg", cv2.imencode(".jpg", frame.color)[1].tobytes())
    return root / "房间.r3d"


def export(root: Path, frames: list[Taken]) -> Path:
    for index, frame in enumerate(frames):
        image(root / f"depth/{index}.tiff", (frame.depth * np.float32(0.001)).astype(np.float32))
        image(root / f"rgb/{index}.jpg", frame.color)
        image(root / f"conf/{index}.png", levels(frame, 0, 2, 1))
    (root / "metadata.json").write_text(json.dumps(metadata(frames)))
    return root


def stray(root: Path, frames: list[Taken], *, is_old: bool = False) -> Path:
    fx, fy, cx, cy = frames[0].K
    root.mkdir(parents=True)
    (root / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0\n")
    (root / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    h, w = frames[0].color.shape[:2]
    video = cv2.VideoWriter(str(root / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60, (w, h))
    lines = [] if is_old else ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for index, frame in enumerate(frames):
        video.write(frame.color)
        numbers = ", ".join(map(str, [*frame.T[:3, 3], *quaternion(frame.T[:3, :3])]))
        lines.append(numbers if is_old else f"{12.5 + index / 60}, {index:06d}, {numbers}")
        image(root / f"confidence/{index:06d}.png", levels(frame, 0, 1, 2))
        (root / "depth").mkdir(exist_ok=True)
        if is_old:
            np.save(root / f"depth/{index:06d}.npy", frame.depth.astype(np.uint32))
        else:
            image(root / f"depth/{index:06d}.png", frame.depth)
    video.release()
    (root / "odometry.csv").write_text("\n".join(lines))
    return root


def polycam(root: Path, frames: list[Taken], *, is_corrected: bool = False) -> Path:
    (root / "keyframes/cameras").mkdir(parents=True)
    (root / "mesh_info.json").write_text("{}")
    for index, frame in enumerate(frames):
        name, T = f"{8_131_000_000 + 300_000 * index}", frame.T @ GL
        said = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        said |= dict(zip(("fx", "fy", "cx", "cy"), frame.K, strict=True))
        said |= {"height": frame.color.shape[0], "width": frame.color.shape[1], "blur_score": 100.0}
        shifted = {**said, "t_03": said["t_03"] + 1} if is_corrected else said
        (root / f"keyframes/cameras/{name}.json").write_text(json.dumps(shifted))
        image(root / f"keyframes/images/{name}.jpg", frame.color // 2 if is_corrected else frame.color)
        image(root / f"keyframes/depth/{name}.png", frame.depth)
        image(root / f"keyframes/confidence/{name}.png", levels(frame, 0, 127, 255))
        if is_corrected:
            image(root / f"keyframes/corrected_images/{name}.jpg", frame.color)
            (root / "keyframes/corrected_cameras").mkdir(exist_ok=True)
            (root / f"keyframes/corrected_cameras/{name}.json").write_text(json.dumps(said))
    return root


def scanner_app(root: Path, frames: list[Taken]) -> Path:
    root.mkdir(parents=True)
    (root / "info.json").write_text('{"device": "iPhone"}')
    for index, frame in enumerate(frames):
        fx, fy, cx, cy = frame.K
        said = {"cameraPoseARFrame": (frame.T @ GL).ravel().tolist(), "time": 100 + index / 10,
                "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "frame_index": index}  # fmt: skip
        (root / f"frame_{index:05d}.json").write_text(json.dumps(said))
        image(root / f"depth_{index:05d}.png", frame.depth)
        image(root / f"conf_{index:05d}.png", levels(frame, 0, 1, 2))
        image(root / f"frame_{index:05d}.jpg", frame.color)
    return root


def arkit_scenes(root: Path, frames: list[Taken]) -> Path:
    lines = []
    for index, frame in enumerate(frames):
        name, T = f"41069021_{300 + index / 10:.3f}", se3.inverse(frame.T)
        turn = cv2.Rodrigues(T[:3, :3])[0].ravel()
        lines.append(f"{300 + index / 10:.9f} " + " ".join(map(str, (*turn, *T[:3, 3]))))
        image(root / f"lowres_depth/{name}.png", frame.depth)
        image(root / f"lowres_wide/{name}.png", frame.color)
        image(root / f"confidence/{name}.png", levels(frame, 0, 1, 2))
        near = root / f"lowres_wide_intrinsics/41069021_{300.001 + index / 10:.3f}.pincam"
        near.parent.mkdir(exist_ok=True)
        near.write_text(f"{frame.color.shape[1]} {frame.color.shape[0]} {' '.join(map(str, frame.K))}")
    (root / "lowres_wide.traj").write_text("\n".join(lines) + "\n")
    return root


WRITERS: dict[str, Callable[[Path, list[Taken]], Path]] = {
    "r3d": r3d,
    "export": export,
    "stray": stray,
    "stray-old": lambda root, frames: stray(root, frames, is_old=True),
    "polycam": polycam,
    "polycam-corrected": lambda root, frames: polycam(root, frames, is_corrected=True),
    "app": scanner_app,
    "arkit": arkit_scenes,
}


def test_every_app_has_a_writer() -> None:
    assert KINDS.keys() == WRITERS.keys()


def same(path: Path, frames: list[Taken]) -> None:
    dataset = open_dataset(path)
    assert (len(dataset), dataset.skipped) == (len(frames), {})
    up = np.array((0, 0, 1) if "ARKit" in dataset.name else (0, 1, 0))
    for index, taken in enumerate(frames):
        frame = dataset.frame(index)
        metres = taken.depth * 0.001
        metres[:2] = 0  # of low confidence
        np.testing.assert_allclose(frame.depth_m, metres, atol=1e-6)
        np.testing.assert_allclose(frame.T_world_camera, taken.T, atol=1e-6)
        wide = frame.depth.shape[1] / taken.color.shape[1]
        fx, fy, cx, cy = taken.K if "stray" not in path.name else frames[0].K
        K = frame.intrinsics
        expected = (fx * wide, fy * wide, (cx + 0.5) * wide - 0.5, (cy + 0.5) * wide - 0.5)
        np.testing.assert_allclose((K.fx, K.fy, K.cx, K.cy), expected, atol=1e-9)
        small = cv2.resize(taken.color, frame.depth.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(frame.color[1:-1, 1:-1].astype(float) - small[1:-1, 1:-1]).mean() < 6
        force = frame.T_world_camera[:3, :3] @ frame.specific_force
        np.testing.assert_allclose(force, 9.81 * up, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_is_recognised_and_gives_the_frames_that_were_taken(tmp_path: Path, kind: str) -> None:
    frames = drawn()
    path = WRITERS[kind](tmp_path / f"{kind} в пути", frames)
    assert find(path).layout.name == KINDS[kind]
    same(path, frames)
    assert "all with poses" in describe(open_dataset(path))
    times = open_dataset(path).timestamps_ns
    assert (times is None) == (kind == "stray-old")
    everything = open_dataset(path, confidence=False)
    np.testing.assert_allclose(everything.frame(1).depth_m, frames[1].depth * 0.001, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_one_frame_is_a_recording(tmp_path: Path, kind: str) -> None:
    frames = drawn(1)
    same(WRITERS[kind](tmp_path / kind, frames), frames)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_real_frames_in_another_apps_layout_give_the_same_keyframes(
    real: list[Taken], tmp_path: Path, kind: str
) -> None:
    same(WRITERS[kind](tmp_path / kind, real), real)


@pytest.mark.slow
def test_a_mesh_of_real_frames_is_the_same_in_two_layouts(
    data: Callable[[str], Path], real: list[Taken], tmp_path: Path
) -> None:
    pytest.importorskip("OpenEXR")
    whole = open_dataset(data("record3d_export"), confidence=False)
    other = open_dataset(scanner_app(tmp_path / "app", real), confidence=False)
    meshes = []
    for keyframes in ([whole[index] for index in range(0, len(whole), 4)], list(other)):
        volume = Volume(voxel_size=0.02, sensor="tof")
        for keyframe in keyframes:
            volume.integrate(keyframe)
        meshes.append(volume.extract_mesh().vertices)
    assert len(meshes[0]) > 1000
    nearest = np.array([np.linalg.norm(meshes[0] - one, axis=1).min() for one in meshes[1][::50]])
    assert np.median(nearest) < 0.001


def test_colour_is_there_for_some_frames_of_the_scanner_app(tmp_path: Path) -> None:
    root = scanner_app(tmp_path / "app", drawn())
    (root / "frame_00001.jpg").unlink()
    dataset = open_dataset(root)
    assert [dataset.frame(index).color is None for index in range(4)] == [False, True, False, False]
    assert dataset.uncolored == 1
    assert "1 without colour in time" in describe(dataset)


def test_poses_fewer_than_frames_and_poses_of_nan_leave_these_out(tmp_path: Path) -> None:
    frames = drawn()
    said = metadata(frames)
    poses = said["poses"]
    assert isinstance(poses, list)
    path = r3d(tmp_path, frames, poses=[poses[0], [float("nan")] * 7, poses[2]])
    dataset = open_dataset(path)
    assert (len(dataset), dataset.skipped) == (2, {"without a pose": 2})
    np.testing.assert_allclose(dataset[1].T_world_camera, frames[2].T, atol=1e-9)
    whole = open_dataset(path, posed=False)
    assert [whole.pose(index) is None for index in range(4)] == [False, True, False, True]


def test_an_old_r3d_file_does_not_state_the_size_of_its_depth(tmp_path: Path) -> None:
    frames = [frame._replace(depth=cv2.resize(frame.depth, (256, 192))) for frame in drawn(2)]
    said = {name: value for name, value in metadata(frames).items() if name not in ("dw", "dh")}
    path = r3d(tmp_path, frames)
    with zipfile.ZipFile(path) as packed:
        files = {name: packed.read(name) for name in packed.namelist()}
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in {**files, "metadata": json.dumps(said).encode()}.items():
            packed.writestr(name, content)
    same(path, frames)


def test_confidence_of_another_size_is_an_error(tmp_path: Path) -> None:
    root = export(tmp_path / "export", drawn())
    for index in range(4):
        image(root / f"conf/{index}.png", np.full((32, 24), 2, np.uint8))
    one_line(lambda: open_dataset(root), "conf.* is 24×32, its depth 32×24; expected equal sizes")
    assert len(open_dataset(root, confidence=False)) == 4


def test_confidence_that_is_low_everywhere_is_said(tmp_path: Path) -> None:
    root = polycam(tmp_path / "capture", drawn())
    for file in (root / "keyframes/confidence").iterdir():
        image(file, np.zeros((24, 32), np.uint8))
    one_line(lambda: open_dataset(root), "is low everywhere .--option confidence=false takes such depth")


def test_a_camera_of_another_shape_is_an_error(tmp_path: Path) -> None:
    root = export(tmp_path / "export", drawn())
    said = json.loads((root / "metadata.json").read_text())
    (root / "metadata.json").write_text(json.dumps({**said, "w": said["h"], "h": said["w"]}))
    one_line(lambda: open_dataset(root), "image 32×24, but camera 96×128; expected the same shape")
    given = open_dataset(
        root, intrinsics=phones.Camera.named((27.5, 27.5, 15.5, 11.5), (24, 32), "").intrinsics
    )
    assert given.frame(0).intrinsics.fx == 27.5


@pytest.mark.parametrize("kind", KINDS)
def test_a_camera_may_be_given(tmp_path: Path, kind: str) -> None:
    path = WRITERS[kind](tmp_path / kind, drawn())
    (tmp_path / "K.txt").write_text("30 0 16\n0 30 12\n0 0 1\n")
    frame = open_dataset(path, calibration=tmp_path / "K.txt").frame(2)
    assert (frame.intrinsics.fx, frame.intrinsics.cx) == (30, 16)
    assert frame.color is not None


Files = dict[str, bytes]


def depths(content: bytes) -> Callable[[Files], object]:
    return lambda files: files.update({f"rgbd/{number}.depth": content for number in range(4)})


def said_to_be(content: bytes) -> Callable[[Files], object]:
    return lambda files: files.update(metadata=content)


def narrowed(files: Files) -> None:
    files["metadata"] = files["metadata"].replace(b'"dw": 32', b'"dw": 0')


def cut(files: Files) -> None:
    files.update({name: content[:90] for name, content in files.items() if name.endswith(".depth")})


BOMB = struct.pack("<4sII", b"bvxn", 4_000_000_000, 4) + b"1234bvx$"
DAMAGE: dict[str, tuple[Callable[[Files], object], str]] = {
    "no metadata": (lambda files: files.pop("metadata"), "holds no metadata"),
    "cut metadata": (said_to_be(b'{"K": [1, 0'), "metadata cannot be read"),
    "metadata of a list": (said_to_be(b"[1]"), "holds no named values"),
    "no size": (said_to_be(b'{"K": [1]}'), "is damaged .no 'h'.; expected"),
    "words": (said_to_be(b'{"h": "x", "w": 3, "K": 0}'), "is damaged"),
    "a size of zero": (narrowed, "expected 0×24 pixels"),
    "cut depth": (cut, "depth is cut off"),
    "other depth": (depths(b"bvxnothing"), "depth is cut off"),
    "no depth": (lambda files: [files.pop(f"rgbd/{n}.depth") for n in range(4)], "no usable frames"),
    "bomb": (depths(BOMB), "holds 4000000000 bytes; expected 32×24 pixels"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_r3d_file_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    path = r3d(tmp_path, drawn())
    with zipfile.ZipFile(path) as packed:
        files = {name: packed.read(name) for name in packed.namelist()}
    change, said = DAMAGE[damage]
    change(files)
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    one_line(lambda: open_dataset(path), said)


def test_a_zip_bomb_a_cut_zip_and_no_zip_are_refused(tmp_path: Path) -> None:
    path = r3d(tmp_path, drawn())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    one_line(lambda: open_dataset(path), "is no whole .r3d file, which is a zip .*; copy it again")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("metadata", bytes(1 << 29))
    one_line(lambda: open_dataset(path), "metadata needs 537 MB of memory; expected at most")


def test_the_library_is_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = r3d(tmp_path, drawn())
    monkeypatch.setitem(__import__("sys").modules, "lzfse", None)
    with pytest.raises(Exception, match=r"a .r3d file needs lzfse: pip install '.\[phone\]'"):
        open_dataset(path)


@pytest.mark.parametrize("kind", ["polycam", "app"])
def test_a_half_written_frame_is_counted_and_the_others_are_there(tmp_path: Path, kind: str) -> None:
    frames = drawn(5)
    root = WRITERS[kind](tmp_path / kind, frames)
    last = sorted(root.rglob("*00004.json" if kind == "app" else "8132*.json"))[-1]
    last.write_text(last.read_text()[:40])
    dataset = open_dataset(root)
    assert (len(dataset), dataset.skipped) == (4, {"with broken metadata": 1})


def test_a_video_is_read_in_any_order_and_ends_where_it_was_cut(tmp_path: Path) -> None:
    frames = drawn(6)
    root = stray(tmp_path / "stray", frames)
    dataset = open_dataset(root)
    order = [3, 1, 5, 5, 0]
    once = [dataset.frame(index).color for index in order]
    for index, color in zip(order, once, strict=True):
        np.testing.assert_array_equal(open_dataset(root).frame(index).color, color)
    for name, extra in (("depth", 8), ("confidence", 8)):
        for index in range(6, extra):
            (root / f"{name}/{index:06d}.png").write_bytes((root / f"{name}/000005.png").read_bytes())
    longer = open_dataset(root, posed=False)
    assert len([1 for _ in (longer.frame(index) for index in range(6))]) == 6
    one_line(lambda: longer.frame(7), "rgb.mp4 has no image 7; expected an image a frame")
    (root / "rgb.mp4").write_bytes(b"no video")
    one_line(lambda: open_dataset(root), "rgb.mp4 has no image 0")


def test_a_video_of_fewer_images_than_frames_is_refused_where_no_times_tell_which(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = drawn()
    root, other = stray(tmp_path / "whole", frames), stray(tmp_path / "other", frames[1:])
    open_dataset(root)
    assert not caplog.text
    (root / "rgb.mp4").write_bytes((other / "rgb.mp4").read_bytes())
    said = "has 3 images for frames up to 3, and times do not tell which .*color=false leaves colour out"
    one_line(lambda: open_dataset(root), said)
    text = (root / "odometry.csv").read_text()
    for time in ("12.5", "noon", "inf", "1e300"):
        (root / "odometry.csv").write_text(re.sub(r"^12\.\d+", time, text, flags=re.MULTILINE))
        one_line(lambda: open_dataset(root), said)


def test_a_frame_whose_image_the_video_lacks_has_no_colour_and_the_others_have_theirs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    av, frames = pytest.importorskip("av"), drawn(6)
    whole = open_dataset(stray(tmp_path / "whole", frames))
    root = stray(tmp_path / "lacks", frames)
    with av.open(str(root / "rgb.mp4")) as old:
        images = [found.to_ndarray(format="bgr24") for found in old.decode(video=0)]
    with av.open(str(root / "rgb.mp4"), "w") as video:
        track = video.add_stream("mpeg4", rate=60)
        track.height, track.width, track.bit_rate = *images[0].shape[:2], 8_000_000
        for number in (0, 1, 3, 4, 5):
            image = av.VideoFrame.from_ndarray(images[number], format="bgr24")
            image.pts, image.time_base = number, Fraction(1, 60)
            video.mux(track.encode(image))
        video.mux(track.encode())
    dataset = open_dataset(root)
    assert "has 5 images for frames up to 5: paired by time" in caplog.text
    assert (dataset.uncolored, dataset.frame(2).color) == (1, None)
    for index in (0, 1, 3, 4, 5):
        seen = [dataset.frame(index).color, *(whole.frame(other).color for other in range(6))]
        apart = [np.abs(np.subtract(seen[0], other, dtype=np.int16)).mean() for other in seen[1:]]
        assert int(np.argmin(apart)) == index


def test_a_folder_of_r3d_files_is_opened_where_there_is_one(tmp_path: Path) -> None:
    path = r3d(tmp_path / "phone", drawn())
    same(tmp_path / "phone", drawn())
    path.with_name("b.r3d").write_bytes(path.read_bytes())
    one_line(lambda: open_dataset(tmp_path / "phone"), "holds 2 datasets; open one of them")


def test_an_empty_folder_is_none_of_them(tmp_path: Path) -> None:
    for name in ("depth", "rgb", "keyframes/depth", "keyframes/cameras", "lowres_depth"):
        (tmp_path / name).mkdir(parents=True)
    one_line(lambda: open_dataset(tmp_path), "no usable frames|in no layout")
    (tmp_path / "odometry.csv").write_text("")
    one_line(lambda: open_dataset(tmp_path), "expected")


def test_a_phone_s_gyroscope_tells_turns(tmp_path: Path) -> None:
    """Core Motion: x right, y up, z to the user. ARKit's images lie on their side: their right is down."""
    frames = drawn(10)
    root = stray(tmp_path / "stray", frames)
    table = (root / "imu.csv").read_text().splitlines()
    for seconds, _, rate in samples():
        right, down, forward = R_SENSOR_IMU @ (rate - BIAS)  # in the axes of the images
        table.append(f"{12.5 + seconds}, 0.0, -1.0, 0.0, {-down}, {-right}, {-forward}")
    (root / "imu.csv").write_text("\n".join(table) + "\n")
    lines = (root / "odometry.csv").read_text().splitlines()
    late = [f"{12.5 + 0.9 + 0.15 * i}, " + line.partition(", ")[2] for i, line in enumerate(lines[1:])]
    (root / "odometry.csv").write_text("\n".join([lines[0], *late]))
    dataset = open_dataset(root)
    assert_known(
        (frame.timestamp_ns / 1e9 - 12.5, frame.attitude) for frame in map(dataset.frame, range(len(dataset)))
    )


def test_a_damaged_table_of_a_gyroscope_refuses_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = stray(tmp_path / "stray", drawn(2))
    (root / "imu.csv").write_text("timestamp, a_x\n1.0, 2.0\n")
    assert len(open_dataset(root)) == 2
    assert "the values of an inertial sensor are not used: " in caplog.text
    assert "imu.csv:2: '1.0, 2.0'; expected" in caplog.text
