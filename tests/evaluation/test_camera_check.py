# SPDX-License-Identifier: MIT
"""Wrong cameras, units of depth and misplaced colour are named; genuine data and crops are not."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from support.corrupted_recordings import FOLDERS, Corrupted, genuine, opened

from tsfusion import cli
from tsfusion.datasets import Dataset, open_dataset, select
from tsfusion.datasets.color_placement import ColorPlace, color_placement, some_frames
from tsfusion.datasets.dataset import Frames
from tsfusion.evaluation.camera_check import centre_doubt
from tsfusion.evaluation.pose_check import PoseCheckReport, check, check_frames
from tsfusion.evaluation.pose_mistakes import MISTAKES, SCALES, Content, scale_text
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.trajectory import quaternion

Data = Callable[[str], Path]
Change = Callable[[Frame], dict[str, object]]


def checked(name: str, change: Change, data: Data) -> PoseCheckReport:
    return check(Corrupted(opened(data(FOLDERS[name])), frame=change))


def camera(change: Callable[[Intrinsics], tuple[float, float, float, float]]) -> Change:
    return lambda frame: {"intrinsics": Intrinsics(*change(frame.intrinsics))}


def zoomed(factor: float) -> Change:
    return camera(lambda K: (K.fx * factor, K.fy * factor, K.cx, K.cy))


def nightly(*values: object) -> object:
    return pytest.param(*values, marks=pytest.mark.nightly)


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("7scenes", 525 / 585),
        ("hololens", 1.2),
        nightly("7scenes", 1.05),
        nightly("redwood", 525 / 585),
        nightly("open3d", 2.0),
        *(nightly(name, f) for name in ("7scenes", "hololens", "redwood") for f in (0.5, 0.8, 0.95, 1.1, 2)),
    ],
)
def test_wrong_focal_length_is_measured(name: str, factor: float, data: Data) -> None:
    report = checked(name, zoomed(factor), data)
    true = opened(data(FOLDERS[name])).frame(0).intrinsics.fx
    assert (report.verdict, report.mistake, report.alternatives) == ("disagree", "focal length", ())
    assert report.fitting_camera[0] == pytest.approx(true, rel=0.02)
    assert report.focal_px[0] == pytest.approx(true * factor, rel=1e-3)
    for words in (
        "too wide" if factor < 1 else "too narrow",
        "--intrinsics fx,fy,cx,cy",
        "--calibration FILE",
    ):
        assert words in report.text


def test_few_frames_of_a_short_way_show_a_wrong_focal_length(data: Data) -> None:
    few = select(opened(data(FOLDERS["7scenes"])), limit=20)
    report = check(Corrupted(few, frame=zoomed(525 / 585)))
    assert (report.verdict, report.mistake) == ("disagree", "focal length")
    assert check(few).verdict == "agree"


@pytest.mark.parametrize("name", ["hololens", nightly("redwood")])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_depth_scale_is_not_taken_for_the_camera(name: str, factor: float, data: Data) -> None:
    report = checked(name, lambda frame: {"depth_scale": frame.depth_scale * factor}, data)
    assert report.mistake == "scale"
    assert report.factor == pytest.approx(factor, rel=0.02)


def along_ray(frame: Frame) -> dict[str, object]:
    lengths = frame.depth * frame.intrinsics.ray_lengths(frame.depth.shape)
    return {"depth": np.rint(np.minimum(lengths, 65535)).astype(np.uint16)}


@pytest.mark.parametrize(
    "name", ["hololens", "room", *(nightly(name) for name in ("7scenes", "redwood", "open3d"))]
)
def test_depth_along_rays_is_named_and_the_option_mends_it(name: str, data: Data) -> None:
    whole = open_dataset("synthetic:room", count=40) if name == "room" else opened(data(FOLDERS[name]))
    wrong = Corrupted(whole, frame=along_ray)
    report = check(wrong)
    assert (report.verdict, report.mistake, report.fitting_camera) == ("disagree", "depth along rays", None)
    assert "along each pixel's ray instead of z" in report.text
    assert "--option depth_along_ray=true" in report.text
    wrong.along_ray = True
    assert check(wrong).verdict == "agree"


def room_in(folder: Path, unit: float, *, posed: bool = True) -> Path:
    """A TUM layout of the synthetic room; depth in some unit."""
    lists: dict[str, list[str]] = {"depth": [], "rgb": [], "groundtruth": []}
    for i, frame in enumerate(open_dataset("synthetic:room", count=20)):
        depth = np.minimum(frame.depth * (frame.depth_scale / unit), 65535).astype(np.uint16)
        for kind, image in (("depth", depth), ("rgb", frame.color)):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / kind / f"{i}.png"), image)
            lists[kind].append(f"{i}.0 {kind}/{i}.png")
        T = frame.T_world_camera
        lists["groundtruth"].append(" ".join(map(str, [float(i), *T[:3, 3], *quaternion(T[:3, :3])])))
    for kind in lists if posed else ("depth", "rgb"):
        (folder / f"{kind}.txt").write_text("\n".join(lists[kind]))
    (folder / "K.txt").write_text(" ".join(map(str, msgspec.structs.astuple(frame.intrinsics))))
    return folder


@pytest.mark.usefixtures("quick_servers")
def test_a_room_of_half_a_metre_is_doubted_where_nothing_states_its_unit(tmp_path: Path) -> None:
    root = room_in(tmp_path / "mine", 0.001, posed=False)
    words = r"all depth is within 0\.\d+ m, which no room is.*0\.2 mm \(5000 a metre\).*depth_scale=0\.001"
    assert run("scan", root, "--out", tmp_path / "out") == 1
    report = check(open_dataset(root, posed=False))
    assert (report.verdict, report.mistake) == ("disagree", "depth unit")
    assert re.search(words, report.text)
    for scale in (0.001, 0.0002):
        assert check_frames(open_dataset(root, posed=False, depth_scale=scale))[0] is None
    (root / "K.txt").rename(root / "calib.txt")
    K = open_dataset("synthetic:room", count=1)[0].intrinsics
    (root / "calib.txt").write_text(f"fx: {K.fx}\ncx: {K.cx}\ncy: {K.cy}\ndepth_scale: 1000\n")
    assert check_frames(open_dataset(root, posed=False))[0] is None
    assert check(open_dataset(room_in(tmp_path / "posed", 0.001))).mistake == "scale"


def test_a_room_that_no_kinect_sees_is_doubted(tmp_path: Path) -> None:
    root = room_in(tmp_path, 1 / 5000, posed=False)
    for name in ("depth.txt", "rgb.txt"):
        (root / name).unlink()
    assert "on average, which no room is" in str(check_frames(open_dataset(root, posed=False))[0])


def test_exchanged_stereo_cameras_are_named(data: Data) -> None:
    pairs = open_dataset(data("euroc_V1_01"), posed=False)
    report = check(Corrupted(pairs, np.asarray, lambda frame: {"left": frame.right, "right": frame.left}))
    assert (report.verdict, report.mistake) == ("disagree", "depth unit")
    assert "the left and right images are exchanged" in report.text


class SidewaysRelief(Frames):
    """A camera that moves along x before a relief: its focal length and its speed look the same."""

    name, sensor, skipped = "relief", "kinect", {}

    def __init__(self, used: float) -> None:
        self._used = used

    def __len__(self) -> int:
        return 20

    def _frame(self, index: int) -> Frame:
        K = Intrinsics(150.0, 150.0, 79.5, 59.5)
        column, row = (side.astype(np.float64) for side in np.meshgrid(np.arange(160), np.arange(120)))
        z = np.full((120, 160), 2.0)
        for _ in range(25):
            x, y = (column - K.cx) / K.fx * z + 0.04 * index, (row - K.cy) / K.fy * z
            z = 0.5 * z + 0.5 * (2 + 0.25 * np.sin(2.5 * x) + 0.2 * np.cos(2 * y + x))
        T = np.eye(4)
        T[0, 3] = 0.04 * index
        return Frame(
            sensor="kinect", T_world_camera=T, depth=(1000 * z).astype(np.uint16),
            intrinsics=Intrinsics(150 * self._used, 150 * self._used, K.cx, K.cy),
        )  # fmt: skip


def test_what_sideways_motion_cannot_tell_apart_is_said() -> None:
    assert check(SidewaysRelief(1.0)).verdict == "agree"
    report = check(SidewaysRelief(0.8))
    assert report.verdict == "disagree"
    assert {report.mistake, *report.alternatives} == {"focal length", "scale"}
    assert "translations" in report.text
    assert "focal length" in report.text


def half_images(frame: Frame) -> dict[str, object]:
    return {"depth": frame.depth[::2, ::2], "color": None if frame.color is None else frame.color[::2, ::2]}


CAMERAS: dict[str, tuple[Change, str]] = {
    "half images": (half_images, "image size"),
    "half K": (camera(lambda K: (K.fx / 2, K.fy / 2, K.cx / 2, K.cy / 2)), "image size"),
    "cx, cy exchanged": (camera(lambda K: (K.fx, K.fy, K.cy, K.cx)), "exchanged centre"),
    "K transposed": (camera(lambda K: (K.fx, K.fy, 0.0, 0.0)), "principal point"),
    "fx too long": (camera(lambda K: (K.fx * 1.15, K.fy, K.cx, K.cy)), "unequal focal lengths"),
}


@pytest.mark.parametrize("mistake", CAMERAS)
@pytest.mark.parametrize("name", ["hololens", nightly("7scenes"), nightly("redwood")])
def test_misread_cameras_are_named(name: str, mistake: str, data: Data) -> None:
    change, expected = CAMERAS[mistake]
    report = checked(name, change, data)
    assert (report.verdict, report.mistake) == ("disagree", expected)
    true = opened(data(FOLDERS[name])).frame(0).intrinsics
    fx, fy, cx, cy = report.fitting_camera
    size = 0.5 if mistake == "half images" else 1.0
    assert (fx, fy) == pytest.approx((size * true.fx, size * true.fy), rel=1e-3)
    assert (cx, cy) == pytest.approx((size * true.cx, size * true.cy), abs=12)  # HoloLens' is 10 pixels off
    assert f"--intrinsics {fx:.5g}," in report.text


def test_exchanged_focal_lengths_are_named(data: Data) -> None:
    def stretched(frame: Frame) -> dict[str, object]:
        K = frame.intrinsics
        wide = cv2.resize(frame.depth, (800, 480), interpolation=cv2.INTER_NEAREST)
        return {"depth": wide, "color": None, "intrinsics": Intrinsics(K.fy, 1.25 * K.fx, 1.25 * K.cx, K.cy)}

    report = checked("7scenes", stretched, data)
    assert report.mistake == "exchanged focal lengths"
    assert report.fitting_camera[:2] == pytest.approx((731.25, 585))


def test_landscape_camera_of_portrait_images_is_named(data: Data) -> None:
    turn = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def turned(frame: Frame) -> dict[str, object]:
        return {"depth": np.rot90(frame.depth, -1).copy(), "color": None}

    scene = opened(data(FOLDERS["7scenes"]))
    report = check(Corrupted(scene, lambda T: T @ turn, turned))
    assert report.mistake == "exchanged centre"
    assert "turned by 90°" in report.text


def test_a_crop_is_no_mistake(data: Data) -> None:
    def cropped(frame: Frame) -> dict[str, object]:
        K = frame.intrinsics
        inner = Intrinsics(K.fx, K.fy, K.cx - 200, K.cy - 120)
        return {"depth": frame.depth[120:, 200:], "color": None, "intrinsics": inner}

    report = checked("7scenes", cropped, data)
    assert (report.verdict, report.text) == ("agree", "poses and depth agree")


def test_the_cropped_images_of_an_azure_kinect_are_no_mistake() -> None:
    undistorted = Intrinsics(437.285, 437.285, 337.605, 364.792)
    assert centre_doubt(undistorted, (576, 640)) is None
    doubt = centre_doubt(Intrinsics(585, 585, 265, 335), (480, 640))
    assert "exchanged" in str(doubt)
    assert "seem wrong" in str(centre_doubt(Intrinsics(585, 585, 440, 240), (480, 640)))


def test_what_frames_cannot_show_of_the_camera_is_doubted(data: Data) -> None:
    report = checked("3dmatch", half_images, data)  # five frames that drift
    assert (report.verdict, report.mistake) == ("disagree", "image size")
    assert "the principal point (320, 240) lies outside the 320×240 images" in report.text
    report = checked("open3d", CAMERAS["cx, cy exchanged"][0], data)  # 5 frames that hardly move
    assert report.verdict == "agree"
    assert "far from the centre of the 640×480 images: cx and cy are exchanged" in report.text


UNITS: dict[str, tuple[Change, str]] = {
    "metres in integers": (lambda f: {"depth": np.rint(f.depth_m).astype(np.uint16)}, "whole metres"),
    "millimetres in floats": (
        lambda f: {"depth": (1000 * f.depth_m).astype(np.float32)},
        "millimetres: divide",
    ),
    "scale 1": (lambda f: {"depth_scale": 1.0}, "depth_scale=0.001"),
}


@pytest.mark.parametrize("mistake", UNITS)
@pytest.mark.parametrize("name", ["open3d", "icl", "3dmatch"])
def test_unusable_depth_is_named(name: str, mistake: str, data: Data) -> None:
    change, words = UNITS[mistake]
    report = checked(name, change, data)
    assert (report.verdict, report.mistake) == ("disagree", "depth unit")
    assert words in report.text


def test_points_in_millimetres_are_named(data: Data) -> None:
    report = check(
        Corrupted(opened(data("kitti07_lidar_keyframes")), frame=lambda f: {"points": 1000 * f.points})
    )
    assert (report.verdict, report.mistake) == ("disagree", "depth unit")
    assert "millimetres were taken for metres" in report.text


def repainted(change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Change:
    return lambda frame: {"color": change(frame.color)}


def moved(x: float, y: float, scale: float = 1.0) -> Change:
    def warped(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
        height, width = color.shape[:2]
        affine = np.array([[scale, 0, x + (1 - scale) * width / 2], [0, scale, y + (1 - scale) * height / 2]])
        return np.asarray(
            cv2.warpAffine(color, affine, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8
        )

    return repainted(warped)


@pytest.mark.parametrize("name", FOLDERS)
def test_registered_color_is_no_matter(name: str, data: Data) -> None:
    assert genuine(data(FOLDERS[name])).color is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (moved(20, 0), "px right of"),
        (moved(0, -16), "px above the depth's"),
        (moved(0, 0, 1.08), "in an image about 9% larger"),
        (moved(0, 0, 0.92), "in an image about 7% smaller"),
    ],
    ids=["right", "up", "larger", "smaller"],
)
@pytest.mark.parametrize("name", ["3dmatch", nightly("redwood"), nightly("7scenes")])
def test_color_beside_the_depth_is_named(name: str, change: Change, words: str, data: Data) -> None:
    report = checked(name, change, data)
    assert report.verdict == "agree"  # the shape is right
    assert words in report.color
    assert report.color in report.text


def test_color_of_another_camera_is_named(data: Data) -> None:
    released = open_dataset(data(FOLDERS["7scenes"]), register=False)
    assert "in an image about 11% smaller" in (check(select(released, limit=40)).color or "")


def place_of(frames: list[Frame]) -> ColorPlace | None:
    return color_placement(frames.__getitem__, len(frames))


@pytest.mark.parametrize(("right", "down", "scale"), [(20, 0, 1.0), (-8, 12, 0.94)])
def test_the_camera_of_misplaced_color_is_found(right: float, down: float, scale: float, data: Data) -> None:
    dataset, change = open_dataset(data(FOLDERS["7scenes"])), moved(right, down, scale)
    given = [dataset.frame(index) for index in some_frames(len(dataset))]
    assert place_of(given) is None  # it lies on the depth already
    place = place_of([replace(frame, **change(frame)) for frame in given])
    assert place is not None
    K, (height, width) = dataset.intrinsics, given[0].shape
    assert place.camera.fx == pytest.approx(K.fx * scale, rel=0.015)
    off = place.camera.cx + place.camera.fx * place.baseline_m / 2.0  # seen at two metres
    assert off == pytest.approx(K.cx * scale + right + (1 - scale) * width / 2, abs=3)
    assert place.camera.cy == pytest.approx(K.cy * scale + down + (1 - scale) * height / 2, abs=3)


@pytest.mark.parametrize("posed", [(0, 20), (92, 116)])
def test_poses_and_broken_frames_change_no_place(posed: tuple[int, int], data: Data, tmp_path: Path) -> None:
    """A scan takes all frames, a replay those with a pose: both find one camera, and count no frame."""
    root = data(FOLDERS["7scenes"])
    source, copied = root / "seq-01", tmp_path / "kitchen" / "seq-01"
    copied.mkdir(parents=True)
    (tmp_path / "kitchen" / "K.txt").symlink_to(root / "camera-intrinsics.txt")
    for number, depth in enumerate(sorted(source.glob("*.depth.png"))):
        for file in source.glob(depth.name.replace("depth.png", "*")):
            if "pose" not in file.name or number in range(*posed):
                (copied / file.name).symlink_to(file)
    broken = copied / "frame-000072.depth.png"
    broken.unlink(missing_ok=True)
    broken.touch()
    found = [open_dataset(tmp_path / "kitchen", posed=each) for each in (True, False)]
    places = [str(each.color_place) for each in found]
    assert places[0] == places[1]
    assert "f 527" in places[0]
    assert not any("unreadable" in each.skipped for each in found)


def test_one_view_again_and_again_tells_no_place(data: Data) -> None:
    frame = open_dataset(data(FOLDERS["7scenes"]), register=False).frame(0)
    assert place_of([frame] * 24) is None


def test_a_late_image_in_a_quick_turn_is_no_other_camera(data: Data) -> None:
    """The turn of freiburg1_360 moves edges aside in all of its frames, as another camera would."""
    assert open_dataset(data("tum_rgbd") / "rgbd_dataset_freiburg1_360", posed=False).color_place is None


class ColorOfOtherFrames(Corrupted):
    def __init__(self, dataset: Dataset, late: int) -> None:
        super().__init__(dataset)
        self._color_of = late

    def _frame(self, index: int) -> Frame:
        color = self._frame_of(min(max(index - self._color_of, 0), len(self) - 1)).color
        shown = super()._frame(index)
        return Frame(sensor="kinect", T_world_camera=shown.T_world_camera, depth=shown.depth,
                     intrinsics=shown.intrinsics, color=color)  # fmt: skip


@pytest.mark.parametrize("name", ["redwood", nightly("7scenes")])
@pytest.mark.parametrize(("late", "words"), [(1, "one frame late"), (-1, "one frame early")])
def test_color_of_another_time_is_named(name: str, late: int, words: str, data: Data) -> None:
    report = check(ColorOfOtherFrames(opened(data(FOLDERS[name])), late))
    assert report.verdict == "agree"
    assert words in (report.color or "")


@pytest.mark.parametrize("name", ["7scenes", "hololens"])
def test_poses_that_see_nothing_twice_give_no_verdict(name: str, data: Data) -> None:
    rng = np.random.default_rng(1)
    report = check(Corrupted(opened(data(FOLDERS[name])), lambda T: se3.exp(rng.normal(size=6)) @ T))
    assert (report.verdict, report.mistake) == ("cannot tell", None)
    assert "fit neither as given nor after any usual correction" in report.text


@pytest.mark.parametrize("name", ["7scenes", "hololens", "room"])
def test_poses_that_see_one_place_and_fit_nowhere_disagree(name: str, data: Data) -> None:
    rng = np.random.default_rng(1)
    whole = open_dataset("synthetic:room", count=40) if name == "room" else opened(data(FOLDERS[name]))
    report = check(Corrupted(whole, lambda T: se3.exp(0.25 * rng.normal(size=6)) @ T))
    assert (report.verdict, report.mistake) == ("disagree", "unexplained")


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["7scenes", "hololens", "redwood"])
def test_no_part_of_genuine_data_is_blamed(name: str, data: Data) -> None:
    whole = opened(data(FOLDERS[name]))
    for start in range(0, len(whole) - 8, len(whole) // 12):
        for stride, limit in ((1, 8), (1, 20), (2, 20), (3, 12)):
            report = check(select(whole, start=start, stride=stride, limit=limit))
            assert (report.verdict, report.color) != ("disagree", None), (start, stride, limit, report.text)
            assert report.color is None


LIDAR, STEREO = Content("points"), Content("disparity")


def test_advice_speaks_of_what_the_data_holds() -> None:
    for text in [mistake.text_for(LIDAR) for mistake in MISTAKES] + [scale_text(f, LIDAR) for f, _ in SCALES]:
        assert not any(word in text for word in ("fy", "intrinsics", "depth", "OpenGL", "Tr"))
    for mistake in MISTAKES:
        assert "read as" not in mistake.text_for(Content())  # of matrices
        assert ("(Tr)" in mistake.text_for(Content("points", kitti=True))) == (mistake.name == "camera axes")
    assert "1/5000" in scale_text(0.2, Content())
    assert "1/5000" not in scale_text(0.2, Content(integer_depth=False)) + scale_text(0.2, STEREO)
    assert "baseline" in scale_text(1.2, STEREO)


def test_quaternions_are_blamed_where_there_are_some(data: Data) -> None:
    recorded = Corrupted(opened(data(FOLDERS["open3d"])))
    assert not any(name.startswith("quaternion") for name in check(recorded).tried)
    recorded.quaternions = True
    assert "quaternion wxyz" in check(recorded).tried


def test_recordings_say_how_rotations_were_written(data: Data) -> None:
    assert not open_dataset(data(FOLDERS["7scenes"])).quaternions
    icl = open_dataset(data(FOLDERS["icl"]))
    assert icl.quaternions
    assert select(icl, limit=2).quaternions


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main([str(each) for each in arguments])
    return int(ended.value.code or 0)


def test_verb_says_which_focal_length_fits(data: Data, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("check", data(FOLDERS["7scenes"])) == 0
    assert "focal length 585 px used, 58" in capsys.readouterr().out


def test_replay_of_a_wrong_camera_ends_with_status_1(
    data: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tsfusion.cli import runs

    whole = data(FOLDERS["7scenes"])
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    (wrong / "seq-01").symlink_to(whole / "seq-01")
    (wrong / "camera-intrinsics.txt").write_text("525 0 319.5\n0 525 239.5\n0 0 1\n")
    out = tmp_path / "out"
    assert run("replay", wrong, "--out", out, "--voxel-size", 0.1, "--max-frames", 60) == 1
    captured = capsys.readouterr()
    wanted = "nothing is fused, as camera and depth disagree: frames fit best with a focal length of about 58"
    assert captured.err.strip().splitlines()[-1].startswith(f"tsfusion: {wanted}")
    assert not out.exists()
    monkeypatch.setattr(runs, "_run", lambda *_, **__: None)
    assert run("replay", wrong, "--no-check") == 0
    assert run("replay", whole) == 0
