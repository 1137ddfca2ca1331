# SPDX-License-Identifier: MIT
"""RealSense without a camera: librealsense's software device, and what it recorded."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import python
from known_turns import R_SENSOR_IMU, STILL_S, assert_known, attitude, samples
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.sources import realsense
from tsfusion.scanner.sources.realsense import RealSense
from tsfusion.scanner.sources.source import Source

try:
    import pyrealsense2 as rs
except ImportError as error:  # also where libusb is missing, which importorskip takes for a failure
    pytest.skip(
        f"pyrealsense2 cannot be loaded ({error}); "
        "pip install '.[realsense]' and apt-get install libusb-1.0-0",
        allow_module_level=True,
    )

H, W, FX, BASELINE = 60, 80, 70.0, 0.05
START_MS, STEP_MS = 1_700_000_000_000.0, 33.25


def images(number: int) -> dict[str, NDArray[Any]]:
    """What the software device shows as its frame `number`."""
    rng = np.random.default_rng(number)
    return {
        "depth": rng.integers(300, 4000, (H, W), dtype=np.uint16),
        "color": rng.integers(0, 256, (H, W, 3), dtype=np.uint8),
        "left": rng.integers(0, 256, (H, W), dtype=np.uint8),
        "right": rng.integers(0, 256, (H, W), dtype=np.uint8),
    }


class Camera:
    """A software device with a stereo and a colour sensor, and if `turns` an inertial one, driven by hand."""

    def __init__(
        self,
        *,
        offset: tuple[float, float, float] = (0, 0, 0),
        coefficients: tuple[float, ...] = (0, 0, 0, 0, 0),
        units: float = 0.001,
        stereo: bool = True,
        pixels: str = "bgr8",
        turns: bool = False,
    ) -> None:
        self.device, self.units = rs.software_device(), units
        self.kinds = {
            "depth": (rs.stream.depth, 0, rs.format.z16, 2),
            "left": (rs.stream.infrared, 1, rs.format.y8, 1),
            "right": (rs.stream.infrared, 2, rs.format.y8, 1),
            "color": (rs.stream.color, 0, getattr(rs.format, pixels), 3),
        }
        self.sensors = {"stereo": self.device.add_sensor("Stereo"), "color": self.device.add_sensor("RGB")}
        self.profiles = {
            name: self.sensor(name).add_video_stream(self.stream(uid, name, coefficients))
            for uid, name in enumerate(self.kinds)
        }
        self.sensors["stereo"].add_read_only_option(rs.option.depth_units, units)
        if stereo:
            self.sensors["stereo"].add_read_only_option(rs.option.stereo_baseline, BASELINE * 1000)
        for name, target, place in (("depth", "color", offset), ("left", "right", (-BASELINE, 0, 0))):
            moved = rs.extrinsics()
            moved.rotation, moved.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], list(place)
            self.profiles[name].register_extrinsics_to(self.profiles[target], moved)
        self.motions = [self.motion(rs.stream.accel, 63), self.motion(rs.stream.gyro, 200)] if turns else []
        self.device.create_matcher(rs.matchers.default)

    def motion(self, kind: Any, fps: int) -> Any:
        stream, place = rs.motion_stream(), rs.extrinsics()
        stream.type, stream.index, stream.fps, stream.fmt = kind, 0, fps, rs.format.motion_xyz32f
        stream.uid = 10 + fps
        sensor = self.sensors.setdefault("motion", None) or self.device.add_sensor("Motion Module")
        self.sensors["motion"] = sensor
        profile = sensor.add_motion_stream(stream)
        place.rotation, place.translation = R_SENSOR_IMU.T.ravel().tolist(), [0.0, 0.0, 0.0]  # by columns
        back = rs.extrinsics()
        back.rotation, back.translation = R_SENSOR_IMU.ravel().tolist(), [0.0, 0.0, 0.0]
        for name in ("depth", "color", "left"):
            profile.register_extrinsics_to(self.profiles[name], place)
            self.profiles[name].register_extrinsics_to(profile, back)
        return profile

    def turn(self, seconds: float, values: tuple[NDArray[np.float64], ...]) -> None:
        """A force and an angular velocity."""
        for profile, value in zip(self.motions, values, strict=True):
            frame = rs.software_motion_frame()
            frame.data, frame.timestamp = vector(value), START_MS + 1000 * seconds
            frame.domain, frame.profile = rs.timestamp_domain.global_time, profile.as_motion_stream_profile()
            frame.frame_number = round(1000 * seconds)
            self.sensors["motion"].on_motion_frame(frame)

    def sensor(self, name: str) -> Any:
        return self.sensors["color" if name == "color" else "stereo"]

    def stream(self, uid: int, name: str, coefficients: tuple[float, ...]) -> Any:
        stream, camera = rs.video_stream(), rs.intrinsics()
        stream.type, stream.index, stream.fmt, stream.bpp = self.kinds[name]
        stream.uid, stream.width, stream.height, stream.fps = uid, W, H, 30
        camera.width, camera.height, camera.fx, camera.fy = W, H, FX + uid, FX + uid
        camera.ppx, camera.ppy = (W - 1) / 2, (H - 1) / 2
        camera.model = rs.distortion.inverse_brown_conrady
        camera.coeffs = list(coefficients) if name == "color" else [0.0] * 5
        stream.intrinsics = camera
        return stream

    def show(
        self,
        number: int,
        shown: dict[str, NDArray[Any]] | None = None,
        *,
        stamp_ms: float | None = None,
        domain: Any = None,
    ) -> None:
        """One exposure of each image."""
        for name, image in (shown or images(number)).items():
            frame = rs.software_video_frame()
            frame.bpp = self.kinds[name][3]
            frame.stride, frame.pixels = W * frame.bpp, image
            frame.timestamp = START_MS + number * STEP_MS if stamp_ms is None else stamp_ms
            frame.domain = domain or rs.timestamp_domain.global_time
            frame.frame_number, frame.profile = number, self.profiles[name].as_video_stream_profile()
            frame.depth_units = self.units if name == "depth" else 0.0
            self.sensor(name).on_video_frame(frame)


def vector(value: NDArray[np.float64]) -> Any:
    made = rs.vector()
    made.x, made.y, made.z = value.tolist()
    return made


def turned(camera: Camera, shown: int, R: NDArray[np.float64] | None = None) -> None:
    """A known turn, in axes turned by R: each exposure comes after `shown` values, from number 1 on."""
    for number, (seconds, *values) in enumerate(samples(), 1):
        camera.turn(seconds, tuple(value if R is None else R @ value for value in values))
        if number % shown == 0:
            camera.show(number // shown, stamp_ms=START_MS + 1000 * seconds)
            time.sleep(0.01)


@contextmanager
def showing(camera: Camera, **options: Any) -> Iterator[None]:
    """Exposures from number 1 on, 100 a second, until left."""
    stop = threading.Event()

    def run() -> None:
        number = 0
        while not stop.wait(0.01):
            number += 1
            camera.show(number, **options)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def number_of(frame: Frame) -> int:
    """The exposure's number, by its time."""
    return round((frame.timestamp_ns / 1e6 - START_MS) / STEP_MS)


def first_frame(camera: Camera, shown: dict[str, NDArray[Any]] | None = None, **options: Any) -> Frame:
    with RealSense(device=camera.device, **options) as source, showing(camera, shown=shown):
        return next(iter(source))


def record(path: Path, numbers: list[int], *, show: Any = None, **options: Any) -> Path:
    """The device's images in a file, by librealsense's own recorder."""
    camera = Camera(**options)
    recorder = rs.recorder(str(path), camera.device)
    queue = rs.frame_queue(1)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for number in numbers:
        camera.show(number)
    if show is not None:
        show(camera)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("realsense") / "room.db3", list(range(1, 13)))


def test_frames_of_a_device() -> None:
    camera = Camera()
    source: Source = RealSense(device=camera.device)
    with source, showing(camera):
        frames = [frame for frame, _ in zip(source, range(5), strict=False)]
    for frame in frames:
        number = number_of(frame)
        assert frame.timestamp_ns == round((START_MS + number * STEP_MS) * 1e6)
        assert (frame.color == images(number)["color"]).all()
        assert frame.kind == "depth"
        assert frame.sensor == source.sensor == "realsense"
        assert frame.depth_scale == 0.001
    assert frames == sorted(frames, key=lambda frame: frame.timestamp_ns)


def turns_of(frames: list[Frame]) -> list[tuple[float, NDArray[np.float64] | None]]:
    return [(frame.timestamp_ns / 1e9 - START_MS / 1e3, frame.attitude) for frame in frames]


def test_a_gyroscope_and_an_accelerometer_tell_turns_and_up() -> None:
    camera = Camera(turns=True)
    with RealSense(device=camera.device) as source:
        found: list[Frame] = []
        reader = threading.Thread(target=lambda: found.extend(source))
        reader.start()
        turned(camera, 8)
        source.close()
        reader.join()
    assert_known(turns_of(found))
    at_rest = next(frame for frame in found if turns_of([frame])[0][0] > STILL_S / 2)
    assert attitude(0) @ at_rest.specific_force == pytest.approx((0, 0, 9.81), abs=0.01)


def test_a_gyroscope_of_unknown_axes_costs_no_frame(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: Any) -> None:
        raise RuntimeError("Requested extrinsics are not available!")

    monkeypatch.setattr(realsense, "_rotation", refuse)
    camera, found = Camera(turns=True), list[Frame]()
    with RealSense(device=camera.device) as source:
        reader = threading.Thread(target=lambda: found.extend(source))
        reader.start()
        turned(camera, 8)
        source.close()
        reader.join()
    assert found
    assert all(frame.attitude is None and frame.specific_force is None for frame in found)
    assert "gyroscope is not used: Requested extrinsics are not available!" in caplog.text


def test_a_recorded_gyroscope_tells_turns(tmp_path: Path) -> None:
    """Librealsense turns the values into the depth camera's axes, and records no extrinsics of the unit."""
    path = record(tmp_path / "turn.db3", [], show=lambda camera: turned(camera, 8, R_SENSOR_IMU), turns=True)
    with RealSense(path) as source:
        assert_known(turns_of(list(source)))


def test_a_recording_gives_back_every_pixel_and_time(recording: Path) -> None:
    with RealSense(recording, color=False) as source:
        frames = list(source)
    assert [frame.timestamp_ns for frame in frames] == [
        round((START_MS + number * STEP_MS) * 1e6) for number in range(1, 13)
    ]
    for number, frame in enumerate(frames, 1):
        assert (frame.depth == images(number)["depth"]).all()
        assert frame.color is None
        assert frame.intrinsics.fx == FX
        assert frame.baseline_fx == pytest.approx(BASELINE * FX)
    assert source.skipped == {}


def test_a_slow_reader_of_a_recording_loses_nothing(recording: Path) -> None:
    numbers = []
    with RealSense(recording) as source:
        for frame in source:
            numbers.append(number_of(frame))
            assert (frame.color == images(numbers[-1])["color"]).all()
            time.sleep(0.02)
    assert numbers == list(range(1, 13))
    assert source.skipped == {}
    assert not source.live


def test_a_recording_stands_still_until_it_is_read(recording: Path) -> None:
    """A recording that plays while its sensors start one after the other would lose their first frames."""
    with RealSense(recording) as source:
        assert source._stream._playback.current_status() != rs.playback_status.playing
        assert not source._stream.over()
        assert [number_of(frame) for frame in source] == [*range(1, 13)]
    RealSense(recording).close()  # that was never read


def test_a_recording_in_real_time_drops_and_counts(tmp_path: Path) -> None:
    """Librealsense then repeats an image beside the other stream's next one: neither is passed on."""
    path = record(tmp_path / "fast.db3", list(range(1, 200)))  # all within a moment
    numbers = []
    with RealSense(path, real_time=True) as source:
        assert source.live
        for frame in source:
            numbers.append(number_of(frame))
            assert (frame.color == images(numbers[-1])["color"]).all()
    assert numbers == sorted(set(numbers))
    assert len(numbers) < 199
    assert len(numbers) + sum(source.skipped.values()) >= numbers[-1] - numbers[0] + 1


@pytest.mark.parametrize("name", ["missing.db3", "garbage.db3", "cut.db3", "old.bag"])
def test_what_cannot_be_played_is_named(name: str, recording: Path, tmp_path: Path) -> None:
    path = tmp_path / name
    if name == "cut.db3":
        path.write_bytes(recording.read_bytes()[:50_000])
    elif name != "missing.db3":
        path.write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    with pytest.raises(SourceError, match=rf"RealSense {name} cannot be opened: .*expected a recording"):
        RealSense(path)


def test_depth_is_brought_onto_colour() -> None:
    """A wall at 1 m, and a colour camera to the right: 7 pixels of the view are the depth camera's alone."""
    camera = Camera(offset=(-0.1, 0, 0), units=0.0001)
    wall = {"depth": np.full((H, W), 10_000, np.uint16), "color": images(1)["color"]}
    frame = first_frame(camera, wall)
    assert frame.intrinsics.fx == FX + 3  # the colour camera's
    assert frame.baseline_fx == pytest.approx(BASELINE * FX)  # the depth camera's: it sets the noise
    seen = frame.depth_m > 0
    assert frame.depth_m[seen] == pytest.approx(1.0, abs=1e-4)
    middle = seen[H // 4 : -H // 4]
    shift = (FX + 3) * 0.1  # pixels, at 1 m
    right_edge = (W - 1) / 2 * (FX + 3) / FX + (W - 1) / 2 - shift
    assert middle[:, : int(right_edge) - 1].all()
    assert not middle[:, int(right_edge) + 3 :].any()
    assert (frame.color == wall["color"]).all()


def test_a_distorted_colour_camera_is_flattened() -> None:
    """Each pixel shows what librealsense says the camera sees in its direction."""
    coefficients = (-0.056, 0.066, 0.0004, -0.0006, -0.02)  # about a D455's
    camera = Camera(coefficients=coefficients)
    column, row = np.meshgrid(np.arange(W), np.arange(H))
    ramp = np.stack([column * 3, row * 4, column * 0], axis=2).astype(np.uint8)
    depth = (1000 + column * 10).astype(np.uint16)
    frame = first_frame(camera, {"depth": depth, "color": ramp})
    own = camera.profiles["color"].as_video_stream_profile().get_intrinsics()
    flat = frame.intrinsics
    moved = 0.0
    for u, v in [(0, 0), (W - 1, 0), (W - 1, H - 1), (0, H - 1), (20, 10), (60, 45), (40, 30)]:
        ray = [(u - flat.cx) / flat.fx, (v - flat.cy) / flat.fy, 1.0]
        x, y = rs.rs2_project_point_to_pixel(own, ray)
        assert -0.01 <= x <= W - 0.99  # every pixel was seen
        assert -0.01 <= y <= H - 0.99
        assert frame.color[v, u, :2] == pytest.approx([3 * x, 4 * y], abs=2)
        z = frame.depth_m[v, u]
        if z > 0:  # of the depth pixel that sees this direction, a pixel or two beside
            ideal = ray[0] * FX + (W - 1) / 2
            assert z == pytest.approx(1 + 0.01 * ideal, abs=0.025)
        moved = max(moved, abs(x - (ray[0] * own.fx + own.ppx)))
    assert moved > 0.3
    assert (frame.depth_m > 0).mean() > 0.9


def test_the_infrared_pair() -> None:
    camera = Camera()
    with RealSense(device=camera.device, images="infrared") as source, showing(camera):
        frame = next(iter(source))
    assert frame.kind == "pair"
    assert (frame.left == images(number_of(frame))["left"]).all()
    assert (frame.right == images(number_of(frame))["right"]).all()
    assert frame.baseline_fx == pytest.approx(BASELINE * (FX + 1))
    assert source.sensor == frame.sensor == "stereo"


def test_a_time_of_flight_camera_has_no_baseline() -> None:
    frame = first_frame(Camera(stereo=False), color=False)
    assert (frame.sensor, frame.baseline_fx) == ("tof", None)


def test_colour_in_the_other_order() -> None:
    frame = first_frame(Camera(pixels="rgb8"))
    assert (frame.color[:, :, ::-1] == images(number_of(frame))["color"]).all()


def test_what_a_slow_consumer_misses_is_counted_and_not_kept() -> None:
    camera = Camera()
    with RealSense(device=camera.device, deadline=0.3) as source:
        for number in range(1, 101):
            camera.show(number)
        numbers: list[int] = []
        with pytest.raises(SourceError):
            numbers.extend(number_of(frame) for frame in source)
    assert numbers[-1] == 100
    assert len(numbers) < 20
    assert sum(source.skipped.values()) == 101 - numbers[0] - len(numbers)


def test_exposures_without_their_colour_are_counted() -> None:
    camera = Camera()
    with RealSense(device=camera.device, deadline=0.3) as source:
        camera.show(1, {"depth": images(1)["depth"]})
        with pytest.raises(SourceError, match=r"no complete frames for 0.3 s. Close other programs"):
            list(source)
    assert source.skipped == {"incomplete": 1}


@pytest.mark.parametrize("domain", ["global_time", "system_time", "hardware_clock"])
def test_the_moment_of_capture(domain: str) -> None:
    camera = Camera()
    late_ms = 4 * STEP_MS
    with RealSense(device=camera.device) as source:
        begun, now_ms = time.monotonic_ns(), time.time() * 1000
        for number in (1, 2, 3):
            stamp_ms = now_ms - late_ms + number * STEP_MS
            camera.show(number, stamp_ms=stamp_ms, domain=getattr(rs.timestamp_domain, domain))
        frame = next(iter(source))
    since_begin_ms = (frame.captured_ns - begun) / 1e6
    if domain == "hardware_clock":  # it says nothing of when that was here
        assert 0 < since_begin_ms < 5000
    else:
        assert since_begin_ms == pytest.approx(frame.timestamp_ns / 1e6 - now_ms, abs=2)
        assert since_begin_ms < 0


def test_close_from_another_thread_ends_the_iteration() -> None:
    camera = Camera()
    source = RealSense(device=camera.device, deadline=60)
    closing = threading.Timer(0.2, source.close)
    closing.start()
    begun = time.monotonic()
    assert list(source) == []
    assert time.monotonic() - begun < 10
    closing.join()
    source.close()


def test_close_in_the_middle_of_a_recording(recording: Path) -> None:
    source = RealSense(recording)
    assert next(iter(source)).kind == "depth"
    source.close()
    source.close()
    assert list(source) == []


def test_ctrl_c_comes_through() -> None:
    program = (
        "import signal, sys, test_realsense as t\n"
        "signal.signal(signal.SIGALRM, signal.default_int_handler)\n"
        "signal.setitimer(signal.ITIMER_REAL, 0.3)\n"
        "try:\n"
        "    with t.RealSense(device=t.Camera().device, deadline=60) as source:\n"
        "        list(source)\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(7)\n"
    )
    assert python(program, cwd=Path(__file__).parent).returncode == 7


def test_a_camera_that_is_not_there() -> None:
    with pytest.raises(SourceError, match="no RealSense camera"):
        RealSense("000000000000")


def test_a_device_without_such_images() -> None:
    device = rs.software_device()
    device.add_sensor("Nothing")
    with pytest.raises(SourceError, match="the camera has 0 of the 1 streams wanted"):
        RealSense(device=device)


def test_contradicting_options() -> None:
    with pytest.raises(InvalidConfig, match="a camera or a device"):
        RealSense("1", device=rs.software_device())
    with pytest.raises(InvalidConfig, match="must be depth or infrared, got 'thermal'"):
        RealSense(images="thermal")  # type: ignore[arg-type]
