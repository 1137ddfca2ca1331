# SPDX-License-Identifier: MIT
"""Folders that another process writes frames to, and live sources by name."""

import json
import os
import signal
import struct
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_processes import Here, python
from numpy.typing import NDArray
from repository import ROOT
from small_recordings import claim_size

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.datasets import open_dataset
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources import watched_folder
from tsfusion.scanner.sources.source import Source, is_live, open_source
from tsfusion.scanner.sources.watched_folder import WatchedFolder

H, W = 24, 32
K = Intrinsics(40.0, 40.0, 15.5, 11.5)


def depth(number: int) -> NDArray[np.uint16]:
    image = np.full((H, W), 1000 + number, np.uint16)
    image[:, : W // 2] += np.random.default_rng(number).integers(0, 50, (H, W // 2), dtype=np.uint16)
    return image


def color(number: int) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (H, W, 3), dtype=np.uint8)


def png(image: NDArray[Any]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def write(root: Path, name: str, content: bytes) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def rgbd(root: Path, number: int, name: str | None = None) -> None:
    name = name or f"{number:06d}"
    write(root, f"depth/{name}.png", png(depth(number)))
    write(root, f"color/{name}.png", png(color(number)))


def camera(root: Path) -> None:
    np.savetxt(root / "K.txt", K.matrix)


def numbers(frames: list[Frame]) -> list[int]:
    """Which frames these are, every pixel of them checked."""
    found = []
    for frame in frames:
        found.append(int(frame.depth[0, -1]) - 1000)
        assert (frame.depth == depth(found[-1])).all()
        if frame.color is not None:
            assert (frame.color == color(found[-1])).all()
        assert frame.intrinsics == K
    return found


def whole(root: Path, **options: Any) -> tuple[WatchedFolder, list[Frame]]:
    """A folder that is written to its end, and its frames."""
    (root / "DONE").touch()
    with WatchedFolder(root, **options) as source:
        return source, list(source)


WRITER = """
    import os, sys, time
    from pathlib import Path
    from test_watched_folder import K, camera, color, depth, np, png, write

    root = Path(sys.argv[1])

    def halves(name, content):
        path = root / name
        path.parent.mkdir(exist_ok=True)
        with path.open("wb", buffering=0) as file:
            file.write(content[: len(content) // 2])
            time.sleep(0.15)
            file.write(content[len(content) // 2 :])

    halves("depth/000000.png", png(depth(0)))
    halves("color/000000.png", png(color(0)))
    (root / "K.txt").write_text("40 0 15.5\\n0 4")  # the camera, too, is half there
    time.sleep(0.15)
    camera(root)
    halves("color/000001.png", png(color(1)))  # colour first
    halves("depth/000001.png", png(depth(1)))
    write(root, "depth/000002.png", b"this is no image")  # garbage for ever
    write(root, "color/000002.png", png(color(2)))
    write(root, "depth/000003.png.part", png(depth(3)))  # written aside
    write(root, "color/000003.png", png(color(3)))
    os.replace(root / "depth/000003.png.part", root / "depth/000003.png")
    write(root, "depth/000004.png", png(depth(4))[:-40])  # never finished
    write(root, "color/000004.png", png(color(4)))
    write(root, "depth/000005.png", png(depth(5)))  # colour never comes
    write(root, "depth/000006.png", png(depth(6)))
    write(root, "color/000006.png", png(color(6))[:10])
    time.sleep(0.3)
    write(root, "color/000006.png", png(color(6)))
    write(root, "depth/000007.png", png(np.zeros((5, 7), np.uint16)))  # of another size
    write(root, "color/000007.png", png(color(7)))
    write(root, "depth/notes.txt", b"hello")
    write(root, "depth/000009.png", png(depth(9)))
    write(root, "color/000009.png", png(color(9)))
    while not (root / "seen-9").exists():
        time.sleep(0.01)
    write(root, "depth/000008.png", png(depth(8)))  # after 9 was taken
    write(root, "color/000008.png", png(color(8)))
    write(root, "depth/000010.png", png(depth(10)))
    write(root, "color/000010.png", png(color(10)))
    (root / "DONE").touch()
"""


def test_a_slow_untidy_writer(tmp_path: Path) -> None:
    command = [sys.executable, "-c", textwrap.dedent(WRITER), str(tmp_path)]
    begun = time.monotonic_ns()
    source: Source = open_source(f"folder:{tmp_path}", deadline=1.0, idle=60.0)
    frames = []
    with subprocess.Popen(command, cwd=Path(__file__).parent) as writer, source:
        for frame in source:
            frames.append(frame)
            if numbers([frame]) == [9]:
                (tmp_path / "seen-9").touch()
        assert writer.wait(30) == 0
    assert numbers(frames) == [0, 1, 3, 6, 9, 10]
    assert source.skipped == {"unreadable": 3, "without its other image": 1, "late": 1}
    stamps = [frame.timestamp_ns for frame in frames]
    assert stamps == sorted(set(stamps))
    now = time.monotonic_ns()
    assert all(begun < frame.captured_ns < now and frame.color is not None for frame in frames)


def test_what_was_there_before_comes_first(tmp_path: Path) -> None:
    camera(tmp_path)
    for number in (10, 9, 2):
        rgbd(tmp_path, number, name=str(number))
    with WatchedFolder(tmp_path) as source:
        frames = iter(source)
        assert numbers([next(frames) for _ in range(3)]) == [2, 9, 10]
        rgbd(tmp_path, 11, name="11")
        assert numbers([next(frames)]) == [11]
        (tmp_path / ".end").touch()
        assert list(frames) == []
    assert source.skipped == {}


def test_names_that_are_times(tmp_path: Path) -> None:
    camera(tmp_path)
    rgbd(tmp_path, 1, name="1305031102.5")
    rgbd(tmp_path, 0, name="1305031102.175304")
    _, frames = whole(tmp_path)
    assert numbers(frames) == [0, 1]
    assert [frame.timestamp_ns for frame in frames] == [1305031102175304000, 1305031102500000000]


def test_fractions_that_the_series_reads_in_another_way_are_refused(tmp_path: Path) -> None:
    """SEC.NSEC without leading zeros: each name alone is decimal seconds."""
    camera(tmp_path)
    for number in range(12):
        nanoseconds = 1305031102 * 10**9 + 90_000_001 * number
        rgbd(tmp_path, number, name=f"{nanoseconds // 10**9}.{nanoseconds % 10**9}")
    with pytest.raises(SourceError, match=r"names such as 1305.* are no decimals.*leading zeros"):
        whole(tmp_path)


def test_names_that_are_no_times_take_the_files(tmp_path: Path) -> None:
    camera(tmp_path)
    rgbd(tmp_path, 0)
    os.utime(tmp_path / "depth" / "000000.png", ns=(1, 1_600_000_000_000_000_000))
    begun = time.monotonic_ns()
    _, (frame,) = whole(tmp_path)
    assert frame.timestamp_ns == 1_600_000_000_000_000_000
    assert frame.captured_ns >= begun  # it was captured long before; the delay is counted from the reading


def test_it_ends_when_nothing_comes(tmp_path: Path) -> None:
    camera(tmp_path)
    rgbd(tmp_path, 0)
    begun = time.monotonic()
    with WatchedFolder(tmp_path, idle=0.4) as source:
        assert numbers(list(source)) == [0]
    assert 0.4 < time.monotonic() - begun < 10


def test_depth_alone(tmp_path: Path) -> None:
    camera(tmp_path)
    for number in range(3):
        write(tmp_path, f"depth/{number}.png", png(depth(number)))
    with WatchedFolder(tmp_path, deadline=0.3, idle=0.3) as source:
        frames = list(source)
    assert numbers(frames) == [0, 1, 2]
    assert all(frame.color is None for frame in frames)
    assert source.skipped == {}


@pytest.mark.parametrize("ending", ["tiff", "npy"])
def test_depth_in_floats(tmp_path: Path, ending: str) -> None:
    """As soon as they are settled; in millimetres they are an error that says so."""
    camera(tmp_path)
    (tmp_path / "depth").mkdir()
    metres = depth(0) * np.float32(0.001)
    for name, image in (("0", metres), ("1", metres * 1000)):
        path = tmp_path / "depth" / f"{name}.{ending}"
        np.save(path, image) if ending == "npy" else cv2.imwrite(str(path), image)
    with WatchedFolder(tmp_path, deadline=0.2, idle=0.5) as source:
        (frame,) = source
        assert (frame.depth == metres).all()
    assert source.skipped == {"unreadable": 1}
    (tmp_path / "depth" / f"0.{ending}").unlink()
    with pytest.raises(SourceError, match=r"in metres, .*: millimetres\? then .* depth_scale=0\.001"):
        whole(tmp_path)
    _, (frame,) = whole(tmp_path, depth_scale=0.001)
    np.testing.assert_allclose(frame.depth, metres, rtol=1e-6)


def test_the_layout_of_7_scenes(data: Callable[[str], Path], tmp_path: Path) -> None:
    recorded = data("7scenes/redkitchen_png/seq-01")
    stems = sorted(path.name[: -len(".depth.png")] for path in recorded.glob("*.depth.png"))[:3]
    np.savetxt(tmp_path / "camera-intrinsics.txt", Intrinsics(585.0, 585.0, 320.0, 240.0).matrix)
    for stem in stems:
        for path in recorded.glob(f"{stem}.*"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    _, frames = whole(tmp_path)
    assert len(frames) == len(stems) == 3
    for stem, frame in zip(stems, frames, strict=True):
        expected = cv2.imread(str(recorded / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED)
        expected[expected == 65535] = 0
        assert (frame.depth == expected).all()
        assert frame.color is not None


def test_color_of_another_camera_is_registered_as_in_a_recording(data: Callable[[str], Path]) -> None:
    root = data("7scenes/redkitchen")
    recording = open_dataset(root, posed=False)
    with WatchedFolder(root / "seq-01", idle=0) as source:
        frames = iter(source)
        for index in range(3):
            frame = next(frames)
            np.testing.assert_array_equal(frame.color, recording.frame(index).color)
            np.testing.assert_array_equal(frame.depth, recording.frame(index).depth)
        assert str(recording.color_place) in source.camera


def test_color_of_a_growing_folder_is_registered_from_the_first_frame_on(
    data: Callable[[str], Path], tmp_path: Path
) -> None:
    kitchen = data("7scenes/redkitchen")
    (tmp_path / "K.txt").symlink_to(kitchen / "camera-intrinsics.txt")
    depths = sorted((kitchen / "seq-01").glob("*.depth.png"))[::5]

    def written(index: int) -> None:
        color = depths[index].with_name(depths[index].name.replace("depth.png", "color.jpg"))
        for file in (depths[index], color):
            (tmp_path / file.name).symlink_to(file)

    written(0)
    half = tmp_path / depths[-1].name.replace("depth.png", "color.jpg")  # shows another place
    half.write_bytes(
        (kitchen / "seq-01" / depths[3].name.replace("depth.png", "color.jpg")).read_bytes()[:-2]
    )
    with WatchedFolder(tmp_path, idle=60, deadline=60) as source, ThreadPoolExecutor() as pool:
        first = pool.submit(next, iter(source))
        for index in range(1, len(depths) - 1):
            written(index)
        (tmp_path / depths[-1].name).symlink_to(depths[-1])
        frame = first.result(timeout=60)
    recording = open_dataset(kitchen, posed=False)
    assert str(recording.color_place) in source.camera
    np.testing.assert_array_equal(frame.color, recording.frame(0).color)


def test_the_first_frame_waits_no_longer_than_frames_come(tmp_path: Path) -> None:
    camera(tmp_path)
    rgbd(tmp_path, 0)
    with WatchedFolder(tmp_path, deadline=0.1) as source:
        assert next(iter(source)).color is not None


def test_a_folder_that_keeps_the_newest_frames_alone_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their number goes up and down for ever."""
    camera(tmp_path)
    rgbd(tmp_path, 0)
    listed, turns = WatchedFolder._list, iter(range(500))  # else the first frame never comes

    def turned_over(source: WatchedFolder) -> list[tuple[str, Path]]:
        if next(turns) % 2:
            rgbd(tmp_path, 1)
        else:
            for kind in ("depth", "color"):
                (tmp_path / kind / "000001.png").unlink(missing_ok=True)
        return listed(source)

    monkeypatch.setattr(WatchedFolder, "_list", turned_over)
    with WatchedFolder(tmp_path, deadline=0.2, poll=0.01) as source:
        assert next(iter(source)).color is not None


def test_an_open3d_camera_and_a_scale(tmp_path: Path) -> None:
    matrix = K.matrix.T.ravel().tolist()
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    rgbd(tmp_path, 0)
    _, (frame,) = whole(tmp_path, depth_scale=0.0002, sensor="tof")
    assert (frame.intrinsics, frame.depth_scale, frame.sensor) == (K, 0.0002, "tof")


def test_rectified_pairs(tmp_path: Path) -> None:
    camera(tmp_path)
    (tmp_path / "baseline.txt").write_text("0.12\n")
    for side, number in (("left", 1), ("right", 2)):
        write(tmp_path, f"{side}/1403715273262142976.png", png(color(number)[:, :, 0]))
    source, (frame,) = whole(tmp_path)
    assert source.sensor == "stereo"
    assert (frame.left == color(1)[:, :, 0]).all()
    assert (frame.right == color(2)[:, :, 0]).all()
    assert frame.baseline_fx == pytest.approx(0.12 * 40)
    assert frame.timestamp_ns == 1403715273262142976
    (tmp_path / "baseline.txt").write_text("120\n")
    with pytest.raises(
        SourceError, match=r"baseline\.txt must hold .* metres, .* 120: are these millimetres"
    ):
        whole(tmp_path)


def test_raw_pairs_with_their_calibration(data: Callable[[str], Path], tmp_path: Path) -> None:
    place = data("euroc_V1_01/mav0")
    for side, name in (("cam0", "left"), ("cam1", "right")):
        for path in (place / side / "data").glob("*.png"):
            write(tmp_path, f"{name}/{path.name}", path.read_bytes())
    _, frames = whole(tmp_path, calibration=place)
    assert len(frames) >= 2
    assert frames[0].baseline_fx / frames[0].intrinsics.fx == pytest.approx(0.1101, abs=1e-4)
    keyframe = frames[0].keyframe(np.eye(4))
    assert (keyframe.disparity > 0).mean() > 0.4


def assert_same(frame: Frame, points: NDArray[np.float32]) -> None:
    np.testing.assert_array_equal(np.asarray(frame.points), points[:, :3])


def settle(path: Path) -> None:
    """Let a file look as if it had been written some time ago."""
    os.utime(path, (time.time() - 100, time.time() - 100))


def test_scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watched_folder, "_AT_REST_S", 60.0)  # a loaded machine is not to reach it
    points = np.abs(np.random.default_rng(0).normal(size=(100, 4))).astype(np.float32)
    write(tmp_path, "velodyne/000000.bin", points.tobytes())
    settle(tmp_path / "velodyne" / "000000.bin")
    with WatchedFolder(tmp_path, poll=0.01, deadline=60.0) as source:
        frames = iter(source)
        assert_same(next(frames), points)
        path = tmp_path / "velodyne" / "000001.bin"
        path.write_bytes(points[:50].tobytes())  # whole points, by chance

        def go_on() -> None:
            with path.open("ab") as file:
                file.write(points[50:].tobytes())
            settle(path)

        writing = threading.Timer(0.2, go_on)
        writing.start()
        assert_same(next(frames), points)
        writing.join()
        write(tmp_path, "velodyne/000002.bin", points.tobytes()[:-3])
        (tmp_path / "DONE").touch()
        assert list(frames) == []
    assert source.skipped == {"unreadable": 1}
    assert source.sensor == "lidar"


def test_points_of_three_numbers_are_refused(tmp_path: Path) -> None:
    good = np.abs(np.random.default_rng(0).normal(size=(100, 4))).astype(np.float32)
    write(tmp_path, "000000.bin", (-good).tobytes())
    settle(tmp_path / "000000.bin")
    with WatchedFolder(tmp_path, poll=0.01, idle=0.2) as source, pytest.raises(SourceError, match="below 0"):
        list(source)
    for number in range(1, 6):
        write(tmp_path, f"{number:06d}.bin", (good if number > 4 else -good).tobytes())
        settle(tmp_path / f"{number:06d}.bin")
    with WatchedFolder(tmp_path, poll=0.01) as source, pytest.raises(SourceError, match="below 0"):
        list(source)  # the first five are enough
    write(tmp_path, "000004.bin", good.tobytes())
    source, frames = whole(tmp_path)
    assert (len(frames), source.skipped) == (2, {"unreadable": 4})


def test_a_lens_that_distorts(tmp_path: Path) -> None:
    (tmp_path / "calibration.yaml").write_text(
        "camera_model: pinhole\nintrinsics: [40, 40, 15.5, 11.5]\ndistortion_model: radtan\n"
        f"distortion_coeffs: [-0.2, 0.02, 0, 0]\nresolution: [{W}, {H}]\n"
    )
    rgbd(tmp_path, 0)
    _, (frame,) = whole(tmp_path, calibration=tmp_path / "calibration.yaml")
    assert frame.intrinsics.fx > 41
    assert not (frame.depth == depth(0)).all()
    assert set(np.unique(frame.depth)) <= set(np.unique(depth(0)))  # moved, never mixed


def test_without_a_camera_it_says_what_is_missing(tmp_path: Path) -> None:
    rgbd(tmp_path, 0)
    with (
        WatchedFolder(tmp_path, deadline=0.2) as source,
        pytest.raises(SourceError, match=r"is not known: no .*K\.txt.*; give --intr"),
    ):
        list(source)
    (tmp_path / "K.txt").write_text("1 2 3\n")
    with WatchedFolder(tmp_path, deadline=0.2) as source, pytest.raises(SourceError, match=r"K\.txt"):
        list(source)


def test_a_folder_that_goes_away(tmp_path: Path) -> None:
    place = tmp_path / "scan"
    place.mkdir()
    camera(place)
    rgbd(place, 0)
    with WatchedFolder(place) as source:
        frames = iter(source)
        next(frames)
        place.rename(tmp_path / "elsewhere")
        with pytest.raises(SourceError, match="scan cannot be read any more"):
            next(frames)


def test_files_that_go_away_while_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where another program clears up what is old."""
    camera(tmp_path)
    for number in (0, 1):
        rgbd(tmp_path, number)
    is_whole = watched_folder.is_whole

    def then_gone(path: Path, *, is_at_rest: bool) -> bool:
        found = is_whole(path, is_at_rest=is_at_rest)
        if path.stem.endswith("0"):
            path.unlink()
        return found

    monkeypatch.setattr(watched_folder, "is_whole", then_gone)
    source, frames = whole(tmp_path)
    assert numbers(frames) == [1]
    assert source.skipped == {"unreadable": 1}


def test_colour_that_its_exif_orientation_alone_turns_is_named(tmp_path: Path) -> None:
    camera(tmp_path)
    upright = color(0).transpose(1, 0, 2)
    data = cv2.imencode(".jpg", upright)[1].tobytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)  # a quarter turn
    exif = b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff
    write(tmp_path, "depth/000000.png", png(depth(0)))
    write(tmp_path, "color/000000.jpg", data[:2] + exif + data[2:])
    with pytest.raises(SourceError, match="an EXIF orientation turns these: save the images turned"):
        whole(tmp_path)


def test_an_image_that_claims_to_be_huge_is_left_out(tmp_path: Path) -> None:
    camera(tmp_path)
    for number in (0, 1):
        rgbd(tmp_path, number)
    claim_size(tmp_path / "depth" / "000000.png", 100_000)
    source, frames = whole(tmp_path)
    assert numbers(frames) == [1]
    assert source.skipped == {"unreadable": 1}


def test_close_from_another_thread_ends_the_iteration(tmp_path: Path) -> None:
    source = WatchedFolder(tmp_path, poll=60)
    closing = threading.Timer(0.2, source.close)
    closing.start()
    assert list(source) == []
    closing.join()


def test_a_handler_of_a_signal_may_close_it(tmp_path: Path) -> None:
    """As `tsfusion scan` does: in the very thread that waits, at any moment."""
    program = (
        "import signal, sys\n"
        "from tsfusion.scanner.sources.source import open_source\n"
        "for turn in range(200):\n"
        "    with open_source('folder:' + sys.argv[1], poll=1e-6) as source:\n"
        "        signal.signal(signal.SIGALRM, lambda *_: source.close())\n"
        "        signal.setitimer(signal.ITIMER_REAL, 0.001 + turn * 1e-6)\n"
        "        assert list(source) == []\n"
    )
    python(program, tmp_path, cwd=ROOT, check=True)


def test_ctrl_c_comes_through(tmp_path: Path) -> None:
    program = (
        "import sys\n"
        "from tsfusion.scanner.sources.source import open_source\n"
        "try:\n"
        "    with open_source('folder:' + sys.argv[1]) as source:\n"
        "        print('open', flush=True)\n"
        "        list(source)\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(7)\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as running:
        assert running.stdout.readline() == b"open\n"
        running.send_signal(signal.SIGINT)
        assert running.wait(30) == 7


@pytest.mark.parametrize(
    "spec", ["realsense", "realsense:123", "camera:0", "camera:/dev/video2", "folder:a:b"]
)
def test_live_specs(spec: str) -> None:
    assert is_live(spec)


@pytest.mark.parametrize("spec", ["/data/kitti", "synthetic:room", "folders", "", "./camera"])
def test_other_specs(spec: str) -> None:
    assert not is_live(spec)
    with pytest.raises(InvalidConfig, match=r"source must be one of realsense, .*folder:PATH, ros2, got"):
        open_source(spec)


def test_options_that_a_source_does_not_take(tmp_path: Path) -> None:
    with pytest.raises(InvalidConfig, match=r"source realsense takes no `calibration`; it takes .*images"):
        open_source("realsense", calibration=tmp_path)
    with pytest.raises(SourceError, match="folder needs the path of one"):
        open_source("folder:")
    with pytest.raises(SourceError, match="is not a folder"):
        open_source(f"folder:{tmp_path / 'none'}", calibration=None)
    with pytest.raises(SourceError, match=r"none\.yaml does not exist"):
        open_source(f"folder:{tmp_path}", calibration=tmp_path / "none.yaml")


def test_a_source_of_another_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "zed_source.py").write_text(
        "def opened(rest, *, fps=30):\n    return ('zed', rest, fps)\n", encoding="utf-8"
    )
    described = tmp_path / "zed_source-1.0.dist-info"
    described.mkdir()
    (described / "METADATA").write_text("Metadata-Version: 2.1\nName: zed-source\nVersion: 1.0\n")
    (described / "entry_points.txt").write_text(
        "[tsfusion.sources]\nzed = zed_source:opened\nbroken = zed_source:absent\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert is_live("zed")
    opened: Any = open_source("zed:14442C", fps=10)
    assert opened == ("zed", "14442C", 10)
    with pytest.raises(InvalidConfig, match="source zed takes no `size`; it takes fps"):
        open_source("zed", size=3)
    with pytest.raises(SourceError, match=r"broken \(zed_source:absent\), .*, cannot be loaded"):
        open_source("broken")
    with pytest.raises(InvalidConfig, match=r"ros2, broken, zed, got 'kinect'"):
        open_source("kinect")


def test_it_says_what_it_waits_for(tmp_path: Path) -> None:
    root = tmp_path / "in"
    root.mkdir()
    said = WatchedFolder(root, idle=10).waits_for()
    assert "no frames yet; waits for depth/NAME.png|tiff|exr|npy with color/, colour/, rgb/" in said
    assert "and for a camera: camera-intrinsics.txt, K.txt" in said
    assert said.endswith(
        "after 10 s without a new frame, when a file DONE or .end appears there, or with Ctrl-C"
    )
    for number in range(3):
        rgbd(root, number)
    camera(root)
    said = WatchedFolder(root).waits_for()
    assert "in: 3 frames are there; waits for more: depth/NAME.png|tiff|exr|npy with color/" in said


def test_the_command_says_what_it_waits_for(here: Here, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    done = here("scan", "folder:in", "--option", "idle=0.1", "--max-frames", 3)
    assert done.returncode == 1
    first, last = done.stderr.splitlines()
    assert first.startswith("in: no frames yet; waits for depth/NAME.png")
    assert first.endswith("poses: found from the frames")
    assert "gave no frames" in last
