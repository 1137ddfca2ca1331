# SPDX-License-Identifier: MIT
"""Stereo cameras that show both images side by side: from files, and live from a camera on the network."""

import http.server
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_processes import python
from interrupts import is_free_after_interrupts
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.datasets.readers import read_image
from tsfusion.geometry.calibration import Rectifier
from tsfusion.geometry.calibration_files import read_rig
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.source import Source
from tsfusion.scanner.sources.stereo_video import CameraThread, StereoVideo

H, W = 48, 64
CAMERA = Intrinsics(60.0, 60.0, 31.5, 23.5)


def picture(number: int) -> NDArray[np.uint8]:
    """Two flat images side by side: `number` on the left, 200 on the right."""
    image = np.full((H, 2 * W, 3), 200, np.uint8)
    image[:, :W] = number
    return image


@pytest.fixture
def numbered(tmp_path: Path) -> str:
    for number in range(5):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), picture(number))
    return str(tmp_path / "%03d.png")


class NetworkCamera:
    """Serves pictures over HTTP as cameras do (multipart JPEG), `rate` a second, `count` of them."""

    def __init__(self, *, rate: float = 50, count: int = 10_000) -> None:
        self.stop, self.sent = threading.Event(), 0
        camera = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    while camera.sent < count and not camera.stop.wait(1 / rate):
                        camera.sent += 1
                        jpeg = cv2.imencode(".jpg", picture(camera.sent % 200))[1].tobytes()
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                        self.wfile.write(head.encode() + jpeg + b"\r\n")
                    camera.stop.wait(60)
                except OSError:
                    return

            def log_message(self, format: str, *args: Any) -> None:
                return

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01})
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_port}/stereo"

    def __enter__(self) -> "NetworkCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def quiet_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENCV_FFMPEG_LOGLEVEL", "-8")


def rectified(place: str, **options: Any) -> StereoVideo:
    return StereoVideo(place, intrinsics=CAMERA, baseline=0.1, **options)


def test_every_picture_of_a_file_in_order(numbered: str) -> None:
    source: Source = rectified(numbered)
    with source:
        frames = list(source)
    assert source.length == len(frames) == 5
    assert not source.live
    for number, frame in enumerate(frames):
        assert frame.kind == "pair"
        assert (frame.left == number).all()
        assert (frame.right == 200).all()
        assert (frame.color == number).all()
        assert (frame.sensor, frame.intrinsics, frame.baseline_fx) == ("stereo", CAMERA, 6.0)
    assert source.skipped == {}


def test_times_of_a_film(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, (2 * W, H))
    for number in range(6):
        writer.write(picture(number))
    writer.release()
    with rectified(str(path)) as source:
        frames = list(source)
    assert [frame.timestamp_ns for frame in frames] == [k * 50_000_000 for k in range(1, 7)]
    assert all(frame.captured_ns > 0 for frame in frames)


def test_raw_pairs_are_rectified(data: Callable[[str], Path], tmp_path: Path) -> None:
    place = data("euroc_V1_01/mav0")
    names = sorted(path.name for path in (place / "cam0" / "data").glob("*.png"))
    raw = [[read_image(place / side / "data" / name, "grey") for side in ("cam0", "cam1")] for name in names]
    for number, pair in enumerate(raw):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.hstack(pair))
    expected = Rectifier(read_rig(place / "cam0" / "sensor.yaml", place / "cam1" / "sensor.yaml"))
    with StereoVideo(str(tmp_path / "%d.png"), calibration=place.parent) as source:
        frames = list(source)
    assert len(frames) == len(raw) >= 2
    for frame, pair in zip(frames, raw, strict=True):
        left, right = expected.pair(*pair)
        assert np.abs(frame.left.astype(int) - left).max() <= 1  # grey by way of colour
        assert np.abs(frame.right.astype(int) - right).max() <= 1
        assert frame.baseline_fx == pytest.approx(expected.baseline_fx)
    depth = frames[0].keyframe(np.eye(4))
    assert (depth.disparity > 0).mean() > 0.4  # an unrectified pair matches hardly anywhere


def test_a_calibration_without_a_size_takes_the_pictures(numbered: str, tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for side in ("1", "2"):
        storage.write(f"M{side}", CAMERA.matrix)
        storage.write(f"D{side}", np.zeros(5))
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-0.1], [0], [0]]))
    storage.release()
    with StereoVideo(numbered, calibration=path) as source:
        frame = next(iter(source))
    assert frame.shape == (H, W)
    assert frame.baseline_fx == pytest.approx(6.0, rel=0.05)


def test_a_live_camera_gives_its_newest_picture(quiet_ffmpeg: None) -> None:
    """A consumer of 10 pictures a second at a camera of 50: none is late, and what it missed is counted."""
    with NetworkCamera() as camera, rectified(camera.url) as source:
        numbers, behind = [], []
        for frame in source:
            behind.append(camera.sent - round(float(frame.left.mean())))
            numbers.append(round(float(frame.left.mean())))
            assert 0 <= time.monotonic_ns() - frame.captured_ns < 2_000_000_000
            assert 0 <= time.time_ns() - frame.timestamp_ns < 2_000_000_000
            if len(numbers) == 12:
                break
            camera.stop.wait(0.1)
    assert numbers == sorted(set(numbers))
    assert np.median(behind[2:]) <= 4  # JPEG, HTTP and FFmpeg hold a few; a queue would hold 5 more each turn
    assert source.skipped["dropped"] >= 20
    assert source.length is None
    assert source.live


def test_a_camera_that_stops(quiet_ffmpeg: None) -> None:
    with NetworkCamera(count=10) as camera, rectified(camera.url, deadline=1) as source:
        frames: list[Any] = []
        with pytest.raises(SourceError, match=rf"camera {camera.url} (stopped|delivered no complete frames)"):
            frames.extend(source)
    assert frames


def test_close_from_another_thread_ends_the_iteration(quiet_ffmpeg: None) -> None:
    with NetworkCamera(count=10) as camera:
        source = rectified(camera.url, deadline=60)
        closing = threading.Timer(1, source.close)
        closing.start()
        frames = list(source)
        closing.join()
        assert len(frames) <= 10
        camera.stop.set()
        source.close()


def test_ctrl_c_comes_through(quiet_ffmpeg: None) -> None:
    program = (
        "import signal, sys\n"
        "from test_stereo_video import rectified\n"
        "signal.signal(signal.SIGALRM, signal.default_int_handler)\n"
        "try:\n"
        "    with rectified(sys.argv[1], deadline=60) as source:\n"
        "        for frame in source:\n"
        "            signal.setitimer(signal.ITIMER_REAL, 0.3)\n"
        "            break\n"
        "        list(source)\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(7)\n"
    )
    with NetworkCamera() as camera:
        assert python(program, camera.url, cwd=Path(__file__).parent).returncode == 7


def test_pictures_of_another_size(numbered: str) -> None:
    expected = (
        rf"camera {numbered} shows 128×48 pixels; expected two images of 64×50 side by side, as calibrated: "
        "128×50"
    )
    with rectified(numbered, size=(50, 64)) as source, pytest.raises(SourceError, match=expected):
        next(iter(source))


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("97", "camera 97 cannot be opened: there is no /dev/video97; (expected one of|no camera is)"),
        ("/dev/video97", "camera /dev/video97 cannot be opened: there is no /dev/video97"),
        ("/dev/null", "camera /dev/null cannot be opened: another program uses /dev/null, or"),
        ("missing.avi", "missing.avi does not exist; expected a camera's number, a device, a URL or a video"),
        ("http://127.0.0.1:9/x", "camera http://127.0.0.1:9/x cannot be opened: nobody answers there"),
        (__file__, "cannot be opened: expected a video that OpenCV can decode"),
    ],
)
def test_what_cannot_be_opened_is_named(place: str, message: str, quiet_ffmpeg: None) -> None:
    with pytest.raises(SourceError, match=message):
        rectified(place)


def test_a_device_without_permission(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(SourceError, match=r"no permission for /dev/null; add the user to its group"):
        rectified("/dev/null")


def test_calibrations_that_do_not_do(numbered: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidConfig, match=r"needs a calibration file \(--calibration\)"):
        StereoVideo(numbered)
    with pytest.raises(SourceError, match=r"no\.yaml is missing"):
        StereoVideo(numbered, calibration=tmp_path / "no.yaml")
    with pytest.raises(SourceError, match=r"holds no calibration of a stereo camera; expected one of cam0"):
        StereoVideo(numbered, calibration=tmp_path)
    (tmp_path / "camera.yaml").write_text("hello: 1\n")
    with pytest.raises(SourceError, match=r"camera\.yaml"):
        StereoVideo(numbered, calibration=tmp_path / "camera.yaml")


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    deadline = time.monotonic() + 10
    while any(thread.name == "camera" for thread in threading.enumerate()):
        assert time.monotonic() < deadline, "a camera's thread is left"
        time.sleep(0.05)


class SlowCamera:
    """A camera that shows nothing yet."""

    def grab(self) -> bool:
        time.sleep(0.01)
        return True

    def retrieve(self) -> tuple[bool, None]:
        return False, None

    def release(self) -> None:
        pass


def test_an_interrupt_leaves_the_camera_free_to_end() -> None:
    """Ctrl-C may come when the lock is just taken: the camera's thread must not wait for it for ever."""
    thread = CameraThread(SlowCamera())
    assert is_free_after_interrupts(lambda: thread.newest(0.0))
    thread.close()
    assert not thread._thread.is_alive()
