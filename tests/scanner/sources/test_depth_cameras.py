# SPDX-License-Identifier: MIT
"""OAK-D and Orbbec without a camera: depthai's own frames and queues, and Orbbec's library as called."""

import sys
import threading
import time
from datetime import timedelta
from types import SimpleNamespace
from typing import Any
from unittest.mock import create_autospec

import numpy as np
import pytest
from known_turns import R_SENSOR_IMU, assert_known, samples
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, MissingDependency, SourceError
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources import depth_cameras
from tsfusion.scanner.sources.depth_cameras import OakD, Orbbec
from tsfusion.scanner.sources.source import is_live, open_source

H, W, FX = 60, 80, 70.0
K = [[FX, 0.0, 39.5], [0.0, FX + 1, 29.5], [0.0, 0.0, 1.0]]
BASELINE_FX = 0.075 * 400


def images(number: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Depth and BGR of exposure `number`."""
    rng = np.random.default_rng(number)
    return rng.integers(300, 4000, (H, W), dtype=np.uint16), rng.integers(0, 256, (H, W, 3), dtype=np.uint8)


# --- OAK-D ---


class OakBench:
    """A pipeline of depthai on this computer, where its Sync joins real messages as on a camera."""

    def __init__(self, dai: Any) -> None:
        self.dai, self.pipeline = dai, dai.Pipeline(False)
        sync = self.pipeline.create(dai.node.Sync)
        sync.setRunOnHost(True)
        self.inputs = {name: sync.inputs[name].createInputQueue() for name in ("depth", "color")}
        self.queue = sync.out.createOutputQueue(maxSize=4, blocking=False)
        self.device = SimpleNamespace(isClosed=lambda: self.is_gone)
        self.is_gone = False
        self.pipeline.start()

    def show(self, number: int, *, rows: int = H, stamp: timedelta | None = None) -> None:
        depth, color = images(number)
        depth = depth[:rows]
        stamp = self.dai.Clock.now() if stamp is None else stamp
        sent = {"depth": self.dai.ImgFrame(), "color": self.dai.ImgFrame()}
        sent["depth"].setCvFrame(depth, self.dai.ImgFrame.Type.RAW16)
        sent["color"].setCvFrame(color, self.dai.ImgFrame.Type.BGR888i)
        for name, frame in sent.items():
            frame.setTransformation(self.dai.ImgTransformation(W, H, K))
            frame.setSequenceNum(number)
            frame.setTimestamp(stamp)
            self.inputs[name].send(frame)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("DEPTHAI_LEVEL", "off")
    made = OakBench(pytest.importorskip("depthai", reason="pip install '.[oak]'"))

    def opened(oak: Any, camera: str | None, size: Any, fps: int) -> None:
        oak._device, oak._pipeline, oak._queue = made.device, made.pipeline, made.queue
        oak.baseline_fx = BASELINE_FX

    monkeypatch.setattr(OakD, "_open", opened)
    yield made
    made.pipeline.stop()


def test_an_oak_gives_depth_colour_and_camera_of_one_exposure(bench: OakBench) -> None:
    before = time.monotonic_ns()
    with open_source("oak") as source:
        frames = iter(source)
        for number in (7, 8, 11):
            bench.show(number)
            frame = next(frames)
            depth, color = images(number)
            assert np.array_equal(frame.depth, depth)
            assert np.array_equal(frame.color, color)
        assert (frame.depth_scale, frame.baseline_fx, frame.sensor) == (0.001, BASELINE_FX, "realsense")
        assert frame.intrinsics == Intrinsics(FX, FX + 1, 39.5, 29.5)
        assert before <= frame.captured_ns <= time.monotonic_ns()
        assert abs(frame.timestamp_ns - time.time_ns()) < 60e9
        assert source.skipped == {"dropped": 2}
        assert source.live


def test_an_oak_s_gyroscope_tells_turns(bench: OakBench) -> None:
    """Real messages, at times of the monotonic clock; axes by depthai's own calibration."""
    dai, socket = bench.dai, bench.dai.CameraBoardSocket
    calibration = dai.CalibrationHandler()
    calibration.setCameraIntrinsics(socket.CAM_A, K, W, H)
    calibration.setImuExtrinsics(socket.CAM_A, R_SENSOR_IMU.tolist(), [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    imu, queue = create_autospec(dai.node.IMU, instance=True), dai.MessageQueue("imu", 4, False)
    imu.out.createOutputQueue.return_value = queue
    place = SimpleNamespace(create=lambda kind: imu)
    gyroscope = depth_cameras.oak_gyroscope(dai, place, calibration)
    imu.enableIMUSensor.assert_called_once_with(dai.IMUSensor.GYROSCOPE_RAW, 200)
    begin, found, number = time.monotonic_ns(), [], 0
    with OakD() as source:
        source._gyroscope = gyroscope
        frames = iter(source)
        for index, (seconds, _, rate) in enumerate(samples()):
            queue.send(inertial_message(dai, begin + round(seconds * 1e9), rate))
            if index % 8 == 7:
                stamp = timedelta(microseconds=begin // 1000 + round(seconds * 1e6))
                bench.show(number := number + 1, stamp=stamp)
                frame = next(frames)
                found.append(((frame.captured_ns - begin) / 1e9, frame.attitude))
    assert_known(found)
    assert not len(depth_cameras.oak_gyroscope(dai, place, dai.CalibrationHandler()).table())


def inertial_message(dai: Any, stamp_ns: int, rate: NDArray[np.float64]) -> Any:
    message, packet, report, stamp = dai.IMUData(), dai.IMUPacket(), dai.IMUReportGyroscope(), dai.Timestamp()
    report.x, report.y, report.z = rate.tolist()
    stamp.sec, stamp.nsec = divmod(stamp_ns, 10**9)
    report.timestamp = stamp
    packet.gyroscope = report
    message.packets = [packet]
    return message


def test_an_exposure_that_comes_twice_is_one_frame(bench: OakBench) -> None:
    with OakD() as source:
        frames = iter(source)
        for number in (1, 1, 2):
            bench.show(number)
        assert [np.array_equal(next(frames).depth, images(n)[0]) for n in (1, 2)] == [True, True]
        assert source.skipped == {}


def test_depth_and_colour_of_two_sizes_are_refused(bench: OakBench) -> None:
    with OakD() as source:
        bench.show(1, rows=H // 2)
        with pytest.raises(
            SourceError, match=r"OAK gives depth \(30, 80\) and colour \(60, 80\); choose another"
        ):
            next(iter(source))


def test_an_oak_that_is_unplugged_or_silent_says_so(bench: OakBench) -> None:
    source = OakD(deadline=0.2)
    with pytest.raises(
        SourceError, match=r"OAK delivered no complete frames for 0\.2 s\. Close other programs"
    ):
        next(iter(source))
    bench.is_gone = True
    bench.queue.close()
    with pytest.raises(SourceError, match="OAK was unplugged; plug it in and start again"):
        next(iter(source))


def test_closing_an_oak_ends_a_waiting_iteration(bench: OakBench) -> None:
    source = OakD(deadline=3600.0)
    timer = threading.Timer(0.3, source.close)
    timer.start()
    assert list(source) == []
    timer.join()


@pytest.mark.parametrize("platform", ["RVC2", "RVC4"])
def test_an_oak_s_streams_have_the_names_and_links_of_depthai(platform: str) -> None:
    dai = pytest.importorskip("depthai", reason="pip install '.[oak]'")
    made: list[Any] = []

    def create(kind: Any) -> Any:
        made.append(create_autospec(kind, instance=True))
        made[-1].kind = kind.__name__
        return made[-1]

    pipeline = SimpleNamespace(create=create)
    queue = depth_cameras.oak_streams(dai, pipeline, getattr(dai.Platform, platform), (H, W), 20)
    by_kind = {one.kind: one for one in made}
    sync, color = by_kind["Sync"], made[0].build.return_value.requestOutput
    assert queue is sync.out.createOutputQueue.return_value
    assert color.call_args.args[0] == (W, H)
    assert color.call_args.kwargs == {"fps": 20, "enableUndistortion": True}
    assert ("ImageAlign" in by_kind) == (platform == "RVC4")
    aligner = by_kind["ImageAlign"] if platform == "RVC4" else by_kind["StereoDepth"].build.return_value
    color.return_value.link.assert_any_call(aligner.inputAlignTo)
    if platform == "RVC2":
        aligner.setOutputSize.assert_called_once_with(W, H)


def test_without_an_oak_the_cure_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    dai = pytest.importorskip("depthai", reason="pip install '.[oak]'")
    monkeypatch.setattr(dai.Device, "getAllAvailableDevices", list)
    with pytest.raises(SourceError, match="no OAK camera found; expected one on a USB 3 port"):
        OakD()
    found = [SimpleNamespace(deviceId="14442C10")]
    monkeypatch.setattr(dai.Device, "getAllAvailableDevices", lambda: found)
    with pytest.raises(SourceError, match="no OAK camera 99; there is 14442C10"):
        OakD("99")


# --- Orbbec ---


class OrbbecBench:
    """pyorbbecsdk as far as it is called, with one camera."""

    class OBError(Exception):
        pass

    def __init__(self, *, baseline_mm: float = 50.0, lens: dict[str, float] | None = None) -> None:
        self.plugged, self.sets, self.failure, self.rows = True, [], None, H
        self.baseline_mm, self.lens = baseline_mm, lens or {}
        self.calls: list[str] = []
        named = lambda *names: SimpleNamespace(**{name: name for name in names})  # noqa: E731
        self.OBSensorType = named("COLOR_SENSOR", "DEPTH_SENSOR")
        self.OBFormat, self.OBLogLevel = named("RGB", "Y16"), named("NONE")
        self.OBStreamType = named("COLOR_STREAM")
        self.OBFrameAggregateOutputMode = named("FULL_FRAME_REQUIRE")
        self.device = SimpleNamespace(
            get_device_info=lambda: SimpleNamespace(get_serial_number=lambda: "CP15"),
            get_baseline=lambda: SimpleNamespace(baseline=self.baseline_mm, zpd=0.0),
        )
        bench = self

        class Context:
            set_logger_to_file = staticmethod(lambda level, folder: bench.calls.append("no log file"))
            set_logger_to_console = staticmethod(lambda level: None)

            def query_devices(self) -> Any:
                return SimpleNamespace(
                    get_count=lambda: int(bench.plugged), get_device_by_index=lambda index: bench.device
                )

        self.Context = Context

    def Config(self) -> Any:  # noqa: N802
        return SimpleNamespace(
            enable_stream=lambda profile: self.calls.append(profile.name),
            set_frame_aggregate_output_mode=self.calls.append,
        )

    def AlignFilter(self, *, align_to_stream: str) -> Any:  # noqa: N802
        return SimpleNamespace(process=lambda frames: SimpleNamespace(as_frame_set=lambda: frames))

    def Pipeline(self, device: Any) -> Any:  # noqa: N802
        assert device is self.device

        def profile(sensor: str, *request: Any) -> Any:
            if self.failure:
                raise self.OBError(self.failure)
            coefficients = dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"), 0.0) | self.lens
            model = SimpleNamespace(name=coefficients.pop("model", "BROWN_CONRADY"))
            return SimpleNamespace(
                name=f"{sensor} {request}",
                get_intrinsic=lambda: SimpleNamespace(fx=FX, fy=FX + 1, cx=39.5, cy=29.5),
                get_distortion=lambda: SimpleNamespace(model=model, **coefficients),
            )

        return SimpleNamespace(
            get_stream_profile_list=lambda sensor: SimpleNamespace(
                get_video_stream_profile=lambda *request: profile(sensor, *request)
            ),
            enable_frame_sync=lambda: self.calls.append("sync"),
            start=lambda config: self.calls.append("start"),
            stop=lambda: self.calls.append("stop"),
            wait_for_frames=self._wait,
        )

    def _wait(self, milliseconds: int) -> Any:
        if not self.sets:
            time.sleep(milliseconds / 1000)
            if not self.plugged:
                raise RuntimeError("device disconnected")
            return None
        number, has_color = self.sets.pop(0)
        depth, color = images(number)
        stamp_us = time.time_ns() // 1000
        shape = {"get_height": lambda: H, "get_width": lambda: W, "get_system_timestamp_us": lambda: stamp_us}
        one = SimpleNamespace(
            get_data=lambda: depth.view(np.uint8).ravel(), get_index=lambda: number,
            get_depth_scale=lambda: float(np.float32(0.1)), **shape,
        )  # fmt: skip
        other = SimpleNamespace(
            get_data=lambda: np.ascontiguousarray(color[:, :, ::-1]).ravel(),
            get_height=lambda: self.rows, get_width=lambda: W,
        )  # fmt: skip
        return SimpleNamespace(
            get_depth_frame=lambda: one, get_color_frame=lambda: other if has_color else None
        )


@pytest.fixture
def orbbec(monkeypatch: pytest.MonkeyPatch) -> OrbbecBench:
    made = OrbbecBench()
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", made)
    return made


def test_an_orbbec_gives_depth_colour_and_camera_of_one_exposure(orbbec: OrbbecBench) -> None:
    orbbec.sets = [(3, True), (3, True), (4, False), (6, True)]
    with open_source("orbbec:CP15", size=(H, W)) as source:
        frames = iter(source)
        first, second = next(frames), next(frames)
    for frame, number in ((first, 3), (second, 6)):
        depth, color = images(number)
        assert np.array_equal(frame.depth, depth)
        assert np.array_equal(frame.color, color)
    assert (first.depth_scale, first.sensor) == (0.0001, "realsense")
    assert first.baseline_fx == pytest.approx(0.05 * FX)
    assert first.intrinsics == Intrinsics(FX, FX + 1, 39.5, 29.5)
    assert 0 <= time.monotonic_ns() - first.captured_ns < 60e9
    assert source.skipped == {"incomplete": 1, "dropped": 1}
    assert orbbec.calls == [
        "no log file", "COLOR_SENSOR (80, 60, 'RGB', 30)", "DEPTH_SENSOR (0, 0, 'Y16', 30)",
        "FULL_FRAME_REQUIRE", "sync", "start", "stop",
    ]  # fmt: skip


def test_an_orbbec_whose_colour_has_another_size_is_refused(orbbec: OrbbecBench) -> None:
    orbbec.sets, orbbec.rows = [(1, True)], H // 2
    with (
        Orbbec(size=(H, W)) as source,
        pytest.raises(SourceError, match=r"colour \(30, 80\); choose another"),
    ):
        next(iter(source))


def test_a_time_of_flight_camera_has_no_baseline(orbbec: OrbbecBench) -> None:
    orbbec.baseline_mm, orbbec.sets = 0.0, [(1, True)]
    with Orbbec(size=(H, W)) as source:
        assert (next(iter(source)).baseline_fx, source.sensor) == (None, "tof")
    with Orbbec(size=(H, W), sensor="kinect") as source:
        assert source.sensor == "kinect"


@pytest.mark.parametrize(
    ("lens", "model", "distortion"),
    [
        ({}, "pinhole", ()),
        ({"k1": 0.1, "k2": -0.05, "p1": 0.001, "k3": 0.01}, "radtan", (0.1, -0.05, 0.001, 0, 0.01, 0, 0, 0)),
        ({"k1": 0.1, "k6": 0.2, "model": "BROWN_CONRADY_K6"}, "radtan", (0.1, 0, 0, 0, 0, 0, 0, 0.2)),
        ({"k1": 0.1, "k4": 0.2, "model": "KANNALA_BRANDT4"}, "equidistant", (0.1, 0, 0, 0.2)),
    ],
)
def test_an_orbbec_s_lens_is_straightened(
    lens: Any, model: str, distortion: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = OrbbecBench(lens=lens)
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", made)
    made.sets = [(1, True)]
    profile = made.Pipeline(made.device).get_stream_profile_list("").get_video_stream_profile()
    camera = depth_cameras.orbbec_camera(profile.get_intrinsic(), profile.get_distortion(), (H, W))
    assert (camera.model, camera.distortion) == (model, distortion)
    with Orbbec(size=(H, W)) as source:
        frame = next(iter(source))
    assert frame.color is not None
    assert np.array_equal(frame.color, images(1)[1]) == (model == "pinhole")


def test_an_orbbec_that_is_not_there_says_so(orbbec: OrbbecBench) -> None:
    with pytest.raises(SourceError, match="no Orbbec camera XY; there is CP15"):
        Orbbec("XY")
    orbbec.failure = "no profile matches"
    with pytest.raises(SourceError, match=r"Orbbec cannot be opened: no profile matches\. Close"):
        Orbbec()
    orbbec.failure = None
    source = Orbbec(size=(H, W))
    orbbec.plugged = False
    with pytest.raises(SourceError, match="Orbbec was unplugged; plug it in"):
        next(iter(source))
    with pytest.raises(SourceError, match="no Orbbec camera found"):
        Orbbec()


def test_orbbec_s_library_has_the_names_that_are_called(orbbec: OrbbecBench, monkeypatch: Any) -> None:
    """Where it is installed: it pins an old NumPy, so it is in no extra."""
    monkeypatch.delitem(sys.modules, "pyorbbecsdk")
    real = pytest.importorskip("pyorbbecsdk", reason="pip install --no-deps pyorbbecsdk2")
    for name in ("OBSensorType", "OBFormat", "OBLogLevel", "OBStreamType", "OBFrameAggregateOutputMode"):
        assert all(hasattr(getattr(real, name), one) for one in vars(getattr(orbbec, name))), name
    for kind, names in {
        real.Context: "set_logger_to_file set_logger_to_console query_devices",
        real.DeviceList: "get_count get_device_by_index",
        real.Device: "get_device_info get_baseline",
        real.Pipeline: "get_stream_profile_list enable_frame_sync start stop wait_for_frames",
        real.StreamProfileList: "get_video_stream_profile",
        real.VideoStreamProfile: "get_intrinsic get_distortion",
        real.Config: "enable_stream set_frame_aggregate_output_mode",
        real.AlignFilter: "process",
        real.FrameSet: "as_frame_set get_depth_frame get_color_frame",
        real.DepthFrame: "get_index get_height get_width get_system_timestamp_us get_data get_depth_scale",
        real.OBCameraIntrinsic: "fx fy cx cy",
        real.OBCameraDistortion: "k1 k2 k3 k4 k5 k6 p1 p2 model",
        real.OBBaselineCalibrationParam: "baseline",
    }.items():
        assert [one for one in names.split() if not hasattr(kind, one)] == []
    assert issubclass(real.OBError, Exception)


# --- both ---


@pytest.mark.parametrize(
    ("name", "module", "cure"),
    [
        ("oak", "depthai", r"OAK-D needs depthai; install it with: pip install '\.\[oak\]'"),
        (
            "orbbec",
            "pyorbbecsdk",
            "Orbbec needs pyorbbecsdk; install it with: pip install --no-deps pyorbbecsdk2",
        ),
    ],
)
def test_without_the_library_the_command_is_named(
    name: str, module: str, cure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert is_live(name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependency, match=cure):
        open_source(name)
    with pytest.raises(InvalidConfig, match=f"source {name} takes no `images`"):
        open_source(name, images="infrared")
