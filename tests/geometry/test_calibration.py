# SPDX-License-Identifier: MIT
"""Lens models against OpenCV's functions, rectification on a real rig, calibration files of every kind."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, Rectifier, StereoRig, Undistorter
from tsfusion.geometry.calibration_files import read_camera, read_rig
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.stereo_matching import Matcher

Data = Callable[[str], Path]
RigAndPairs = tuple[StereoRig, list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]]
K = Intrinsics(458.654, 457.296, 367.215, 248.375)
RADTAN = Camera(K, (480, 752), "radtan", (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))
KINECT = Camera(
    Intrinsics(517.3, 516.5, 318.6, 255.3), (480, 640), "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)
FISHEYE = Camera(
    Intrinsics(190.9, 190.9, 254.9, 256.8), (512, 512), "equidistant", (0.0034, 0.0007, -0.002, 0.0002)
)
SKEWED = Camera(Intrinsics(150, 150, 79.5, 59.5), (120, 160), skew=25.0)
CAMERAS = {"euroc": RADTAN, "kinect": KINECT, "fisheye": FISHEYE}


def grid(size: tuple[int, int], step: int = 7) -> NDArray[np.float64]:
    """Every so many pixels, (n, 2) columns and rows."""
    v, u = np.mgrid[: size[0] : step, : size[1] : step]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)


def wave(camera: Camera, u: NDArray[np.floating], v: NDArray[np.floating]) -> NDArray[np.uint8]:
    """What a camera sees of a smooth pattern far away, at pixels."""
    rays = camera.rays(np.stack([np.ravel(u), np.ravel(v)], axis=1))
    x, y = (rays / np.linalg.norm(np.column_stack([rays, np.ones(len(rays))]), axis=1)[:, None]).T
    picture = 127 + 60 * np.sin(9 * x) + 60 * np.cos(11 * y)
    return np.asarray(picture.reshape(np.shape(u)).round(), np.uint8)


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_and_pixels_are_each_others_inverse(name: str) -> None:
    camera = CAMERAS[name]
    pixels = grid(camera.size)
    rays = camera.rays(pixels)
    within = np.linalg.norm(rays, axis=1) < 1.7  # beyond 60° they are cut off
    back = camera.project(np.column_stack([rays, np.ones(len(rays))]))
    assert within.mean() > 0.4
    assert np.abs(back - pixels)[within].max() < 1e-6


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_are_opencvs(name: str) -> None:
    camera = CAMERAS[name]
    pixels = grid(camera.size)
    pixels = pixels[np.linalg.norm(pixels - (camera.intrinsics.cx, camera.intrinsics.cy), axis=1) < 150]
    undistort = cv2.fisheye.undistortPoints if camera.model == "equidistant" else cv2.undistortPoints
    expected = undistort(pixels[:, None], camera.intrinsics.matrix, np.array(camera.distortion))
    assert camera.rays(pixels) == pytest.approx(expected[:, 0], abs=2e-5)


@pytest.mark.parametrize("keep", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", CAMERAS)
def test_undistorted_picture_is_what_a_pinhole_camera_sees(name: str, keep: float) -> None:
    full = CAMERAS[name]
    quarter = (full.size[0] // 4, full.size[1] // 4)
    camera = Camera(full.intrinsics.scaled(0.25), quarter, full.model, full.distortion)
    flat = Undistorter(camera, keep=keep)
    v, u = np.mgrid[: camera.size[0], : camera.size[1]]
    got = flat.image(wave(camera, u, v))
    expected = wave(Camera(flat.intrinsics, flat.size), u, v)
    seen = flat.image(np.full(camera.size, 255, np.uint8)) == 255
    assert seen.all() == (keep == 0 or name == "fisheye")  # which sees beyond the 60° that are flattened
    assert np.percentile(np.abs(got.astype(int) - expected)[seen], 99) <= 2


@pytest.mark.parametrize("name", ["euroc", "kinect"])
def test_keeping_all_loses_no_pixel(name: str) -> None:
    camera = CAMERAS[name]
    flat = Undistorter(camera, keep=1).intrinsics
    rays = camera.rays(grid(camera.size))
    pixels = rays * (flat.fx, flat.fy) + (flat.cx, flat.cy)
    assert pixels.min() > -1
    assert (pixels < np.array(camera.size[::-1])).all()


def test_undistorted_depth_holds_values_that_were_there() -> None:
    depth = np.zeros(RADTAN.size, np.uint16)
    depth[::2] = 1000
    depth[1::2] = 3000
    flat = Undistorter(RADTAN)
    assert set(np.unique(flat.depth(depth))) == {1000, 3000}
    row = np.arange(480, dtype=np.uint16)[:, None] + np.zeros(752, np.uint16) + 1
    exact = Undistorter(RADTAN).image(row.astype(np.float32))
    assert np.abs(flat.depth(row) - exact).max() <= 0.55  # the nearest, not the one before


def test_a_camera_without_distortion_stays_as_it_is() -> None:
    flat = Undistorter(Camera(Intrinsics(500, 500, 320, 240), (480, 640)))
    assert flat.intrinsics.fx == pytest.approx(500, rel=2 / 480)


@pytest.mark.parametrize(
    "camera", [SKEWED, replace(RADTAN, skew=20.0).resized((240, 376))], ids=["pinhole", "lens"]
)
def test_skew_is_part_of_the_lens(camera: Camera) -> None:
    K, matrix = camera.intrinsics, camera.intrinsics.matrix
    matrix[0, 1] = camera.skew
    assert Camera.named(matrix, camera.size, camera.model, camera.distortion) == camera
    pixels = grid(camera.size)
    ones = np.ones((len(pixels), 1))
    rays = np.hstack([camera.rays(pixels), ones])
    straight = replace(camera, skew=0.0).project(rays)
    straight[:, 0] += camera.skew * (straight[:, 1] - K.cy) / K.fy
    np.testing.assert_allclose(camera.project(rays), straight, atol=1e-9)
    np.testing.assert_allclose(straight, pixels, atol=1e-6)
    undistorter = Undistorter(camera)
    v, u = np.mgrid[: camera.size[0], : camera.size[1]].astype(np.float64)
    flat = Camera(undistorter.intrinsics, camera.size)
    found = undistorter.image(wave(camera, u, v)).astype(int) - wave(flat, u, v)
    assert np.abs(found).mean() < 1
    assert camera.resized((camera.size[0] * 2, camera.size[1] * 2)).skew == 2 * camera.skew


def test_image_of_another_size_is_refused() -> None:
    with pytest.raises(InvalidConfig, match="752×480, got 640×480"):
        Undistorter(RADTAN).image(np.zeros((480, 640), np.uint8))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"model": "fov"}, "model of a camera must be one of pinhole, radtan, equidistant"),
        ({"distortion": (0.1, 0.2)}, "must be 4 or 5 or 8 or 12 or 14 finite numbers"),
        ({"distortion": (np.nan, 0.0, 0.0, 0.0)}, "finite"),
        ({"size": (0, 640)}, "size of a camera must be"),
        ({"intrinsics": Intrinsics(0, 1, 1, 1)}, "fx > 0"),
    ],
)
def test_wrong_camera_is_named(fields: dict[str, object], message: str) -> None:
    given = {"intrinsics": K, "size": (480, 752), "model": "radtan", "distortion": (0.0, 0.0, 0.0, 0.0)}
    with pytest.raises(InvalidConfig, match=message):
        Camera(**{**given, **fields})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def euroc(data: Data) -> RigAndPairs:
    """The rig of EuRoC V1_01 and its pairs."""
    root = data("euroc_V1_01") / "mav0"
    rig = read_rig(root / "cam0/sensor.yaml", root / "cam1/sensor.yaml")
    pairs = []
    for left in sorted((root / "cam0/data").glob("*.png")):
        images = [cv2.imread(str(root / cam / "data" / left.name), 0) for cam in ("cam0", "cam1")]
        pairs.append((np.asarray(images[0], np.uint8), np.asarray(images[1], np.uint8)))
    return rig, pairs


def row_errors(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float64]:
    """|rows apart| of corners followed from one image to the other and back."""
    corners = cv2.goodFeaturesToTrack(left, 400, 0.01, 8)
    window = {"winSize": (21, 21), "maxLevel": 4}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, None, **window)  # type: ignore[call-overload]
    back, again, _ = cv2.calcOpticalFlowPyrLK(right, left, moved, None, **window)  # type: ignore[call-overload]
    good = (found & again)[:, 0].astype(bool) & (np.linalg.norm((back - corners)[:, 0], axis=1) < 0.3)
    assert good.sum() > 150
    return np.asarray(np.abs((moved - corners)[good, 0, 1]), np.float64)


def test_euroc_rows_match_after_rectification(euroc: RigAndPairs) -> None:
    rig, pairs = euroc
    rectifier = Rectifier(rig)
    before = row_errors(*pairs[0])
    after = row_errors(*rectifier.pair(*pairs[0]))
    assert np.median(before) > 5
    assert np.median(after) < 0.3
    assert np.percentile(after, 80) < 0.5


def test_euroc_geometry_is_opencvs(euroc: RigAndPairs) -> None:
    rig, _ = euroc
    sides = [(c.intrinsics.matrix, np.array(c.distortion)) for c in (rig.left, rig.right)]
    R, t = rig.T_right_left[:3, :3], rig.T_right_left[:3, 3:]
    R_left, _, P_left, P_right = cv2.stereoRectify(*sides[0], *sides[1], (752, 480), R, t, alpha=0)[:4]
    rectifier = Rectifier(rig)
    assert P_left[0, 0] == pytest.approx(436.24, abs=0.01)
    assert rectifier.intrinsics.fx == pytest.approx(P_left[0, 0], rel=0.01)
    assert rectifier.baseline_m == pytest.approx(-P_right[0, 3] / P_right[0, 0])
    assert rectifier.baseline_m == pytest.approx(0.11008, abs=1e-5)
    assert rectifier.baseline_fx == pytest.approx(0.11008 * rectifier.intrinsics.fx, rel=1e-4)
    assert rectifier.T_left_rectified[:3, :3] == pytest.approx(R_left.T)


def test_euroc_depth_agrees_between_frames(euroc: RigAndPairs) -> None:
    rig, pairs = euroc
    rectifier = Rectifier(rig)
    disparity = [Matcher(search=96)(*rectifier.pair(*pair)) / 16 for pair in (pairs[0], pairs[-1])]
    both = (disparity[0] > 2) & (disparity[1] > 2)  # the drone stands still
    depth = [rectifier.baseline_fx / each[both] for each in disparity]
    assert both.mean() > 0.4
    assert np.median(np.abs(depth[0] - depth[1])) < 0.008


def synthetic_rig(model: str) -> StereoRig:
    """Two slightly turned cameras 20 cm apart."""
    cameras = {"radtan": RADTAN, "equidistant": FISHEYE}
    T = se3.exp(np.array([-0.2, 0.004, -0.006, 0.02, -0.03, 0.01]))
    return StereoRig(cameras[model], cameras[model], T)


@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_rectified_points_have_one_row_and_their_depth_in_the_disparity(model: str) -> None:
    rig = synthetic_rig(model)
    rectifier = Rectifier(rig)
    rng = np.random.default_rng(3)
    points = rng.uniform((-0.7, -0.7, 1.5), (0.7, 0.7, 4), (200, 3))
    flat = rectifier.intrinsics
    in_rectified = points @ rectifier.T_left_rectified[:3, :3]
    column = in_rectified[:, 0] / in_rectified[:, 2] * flat.fx + flat.cx
    row = in_rectified[:, 1] / in_rectified[:, 2] * flat.fy + flat.cy
    disparity = rectifier.baseline_fx / in_rectified[:, 2]
    inside = (column > 20) & (column < rectifier.size[1] - 20) & (row > 20) & (row < rectifier.size[0] - 20)
    assert inside.sum() > 30
    sides = ((rig.left, points, column), (rig.right, se3.apply(rig.T_right_left, points), column - disparity))
    for side, (camera, seen, columns) in enumerate(sides):
        pixels = camera.project(seen)
        for index in np.flatnonzero(inside)[:15]:
            dot = np.zeros(camera.size, np.float32)
            x, y = np.round(pixels[index] * 256).astype(int).tolist()
            cv2.circle(dot, (x, y), 6 * 256, 1, -1, shift=8)
            image = rectifier.pair(dot, dot)[side]
            if not image.any():
                continue  # to the left of the right image
            v, u = np.nonzero(image)
            centre = np.average(np.stack([u, v]), axis=1, weights=image[v, u])
            assert centre == pytest.approx((columns[index], row[index]), abs=0.6)


def test_swapped_and_vertical_rigs_are_named() -> None:
    def rig(x: float, y: float) -> StereoRig:
        T = np.eye(4)
        T[:2, 3] = x, y
        return StereoRig(RADTAN, RADTAN, T)

    Rectifier(rig(-0.1, 0))
    with pytest.raises(InvalidConfig, match="swap them"):
        Rectifier(rig(0.1, 0))
    with pytest.raises(InvalidConfig, match="side by side"):
        Rectifier(rig(0, 0.1))
    with pytest.raises(InvalidConfig, match="baseline"):
        rig(0, 0)


def numbers(values: NDArray[np.floating]) -> str:
    return ", ".join(repr(float(value)) for value in np.ravel(values))


def matrix(name: str, values: NDArray[np.floating]) -> str:
    rows, columns = np.atleast_2d(values).shape
    head = f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
    words = numbers(values).replace(", ", ",\n       ", 2)
    return f"{head}   data: [ {words} ]\n"


def camera_info(camera: Camera, R: NDArray[np.float64], P: NDArray[np.float64]) -> str:
    def block(name: str, rows: int, values: NDArray[np.floating]) -> str:
        columns = np.size(values) // rows
        return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{numbers(values)}]\n"

    height, width = camera.size
    model = {"radtan": "plumb_bob", "equidistant": "equidistant"}[camera.model]
    return (
        f"image_width: {width}\nimage_height: {height}\ncamera_name: narrow_stereo/left\n"
        f"{block('camera_matrix', 3, camera.intrinsics.matrix)}distortion_model: {model}\n"
        f"{block('distortion_coefficients', 1, np.array(camera.distortion))}"
        f"{block('rectification_matrix', 3, R)}{block('projection_matrix', 3, P)}"
    )


def rectification(rig: StereoRig) -> list[NDArray[np.float64]]:
    """R1 R2 P1 P2 as calibration programs write them."""
    K, still = rig.left.intrinsics.matrix, np.zeros(5)
    R, t = rig.T_right_left[:3, :3], rig.T_right_left[:3, 3:]
    return [np.asarray(each) for each in cv2.stereoRectify(K, still, K, still, rig.left.size[::-1], R, t)[:4]]


def write(rig: StereoRig, layout: str, folder: Path) -> list[Path]:
    """The rig's files in a layout."""
    (R1, R2, P1, P2), left, right = rectification(rig), rig.left, rig.right
    R, T = matrix("R", rig.T_right_left[:3, :3]), matrix("T", rig.T_right_left[:3, 3:])
    sides = "".join(
        matrix(f"M{n}", c.intrinsics.matrix) + matrix(f"D{n}", np.array(c.distortion))
        for n, c in ((1, left), (2, right))
    )
    given = "" if left.model == "radtan" else "distortion_model: equidistant\n"
    head = "%YAML:1.0\n---\n"
    texts = {
        "kalibr": [kalibr(rig)],
        "ros": [camera_info(left, R1, P1), camera_info(right, R2, P2)],
        "opencv": [f"{head}image_size: [ {size_of(left)} ]\n{sides}{R}{T}{given}"],
        "opencv, two files": [head + sides + given, head + R + T],
        "orb-slam": [head + orb_slam(rig) + given],
    }[layout]
    paths = [folder / f"{index}.yaml" for index in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths


def size_of(camera: Camera) -> str:
    return f"{camera.size[1]}, {camera.size[0]}"


def orb_slam(rig: StereoRig) -> str:
    R1, R2, P1, P2 = rectification(rig)
    text = ""
    for side, camera, R, P in (("LEFT", rig.left, R1, P1), ("RIGHT", rig.right, R2, P2)):
        text += f"{side}.height: {camera.size[0]}\n{side}.width: {camera.size[1]}\n"
        text += matrix(f"{side}.D", np.array(camera.distortion))
        text += matrix(f"{side}.K", camera.intrinsics.matrix)
        text += matrix(f"{side}.R", R) + matrix(f"{side}.P", P)
    return f"Camera.fps: 20.0\n{text}"


def kalibr(rig: StereoRig) -> str:
    text = ""
    for index, camera in enumerate((rig.left, rig.right)):
        text += f"cam{index}:\n"
        if index:
            rows = "".join(f"  - [{numbers(row)}]\n" for row in rig.T_right_left)
            text += f"  T_cn_cnm1:\n{rows}"
        K = camera.intrinsics
        text += (
            f"  cam_overlaps: [{1 - index}]\n  camera_model: pinhole\n"
            f"  distortion_coeffs: [{numbers(np.array(camera.distortion))}]\n"
            f"  distortion_model: {camera.model}\n"
            f"  intrinsics: [{K.fx}, {K.fy}, {K.cx}, {K.cy}]\n"
            f"  resolution: [{size_of(camera)}]\n  rostopic: /cam{index}/image_raw\n"
        )
    return text


@pytest.mark.parametrize("layout", ["kalibr", "ros", "opencv", "opencv, two files", "orb-slam"])
@pytest.mark.parametrize("model", ["radtan", "equidistant"])
def test_rig_comes_back_from_its_files(layout: str, model: str, tmp_path: Path) -> None:
    rig = synthetic_rig(model)
    size = rig.left.size if layout == "opencv, two files" else None
    got = read_rig(*write(rig, layout, tmp_path), size=size)
    assert got.left == rig.left
    assert got.right == rig.right
    assert got.T_right_left == pytest.approx(rig.T_right_left, abs=1e-9)


def test_opencvs_own_writer_is_read(tmp_path: Path) -> None:
    rig = synthetic_rig("radtan")
    for suffix in ("yml", "json", "xml"):
        path = tmp_path / f"stereo.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in (
            ("K1", rig.left.intrinsics.matrix), ("D1", np.array(rig.left.distortion)),
            ("K2", rig.right.intrinsics.matrix), ("D2", np.array(rig.right.distortion)),
            ("R", rig.T_right_left[:3, :3].copy()), ("T", rig.T_right_left[:3, 3:].copy()),
        ):  # fmt: skip
            storage.write(name, value)
        storage.release()
        got = read_rig(path, size=(480, 752))
        assert got.left == rig.left
        assert got.T_right_left == pytest.approx(rig.T_right_left)


def test_cameras_of_one_file(tmp_path: Path, data: Data) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(camera_info(KINECT, np.eye(3), np.eye(3, 4)))
    assert read_camera(path) == KINECT
    path.write_text(kalibr(synthetic_rig("radtan")))
    assert read_camera(path) == RADTAN
    assert read_camera(data("euroc_V1_01") / "mav0/cam0/sensor.yaml") == RADTAN


K_LINE, VGA = "intrinsics: [500, 500, 320, 240]\n", "resolution: [640, 480]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "is missing"),
        ("", "no named values"),
        ("cam0: {a: [1, 2", "is not YAML, JSON or XML"),
        ("just words\n", "is not YAML|no named values"),
        ("fps: 30\n", "no camera in it, only fps"),
        ("intrinsics: [1, 2, 3]\nresolution: [640, 480]\n", "camera matrix must have 9 numbers"),
        (K_LINE, "does not say the size"),
        (f"camera_model: omni\nintrinsics: [1, 500, 500, 320, 240]\n{VGA}", "must be pinhole"),
        (f"{K_LINE}{VGA}distortion_model: fov\ndistortion_coeffs: [0.9]\n", "distortion model must be one"),
        (f"camera_matrix: [500, x, 320, 0, 1, 1, 0, 0, 1]\n{VGA}", "could not convert"),
        ("intrinsics: [500, 500, 320, 240]\nresolution: [1000000, 1000000]\n", "2 to 8192 pixels a side"),
        ("intrinsics: [500, 500, 320, 240]\nresolution: [.Inf, 480]\n", "infinity"),
        ('{"a":' + "[" * 100_000 + "]" * 100_000 + "}", "far too large or too deep"),
        ("a: " + "[" * 100_000, "far too large or too deep"),
        ("<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000, "far too large or too deep"),
        ("\n".join(f"{' ' * i}a{i}:" for i in range(1000)), "far too large or too deep"),
        ("a: 1\n" * 300_000, "far too large or too deep"),
    ],
)
def test_bad_files_are_named(text: str | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DatasetError, match=message) as caught:
        read_camera(path)
    assert str(path) in str(caught.value)
    assert "expected Kalibr" in str(caught.value)


def test_rig_without_extrinsics_is_named(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(kalibr(synthetic_rig("radtan")).replace("T_cn_cnm1", "T_imu_cam"))
    with pytest.raises(DatasetError, match="has no 'T_cn_cnm1'"):
        read_rig(path)
    path.write_text("fps: 30\n")
    with pytest.raises(DatasetError, match="no pair of cameras in it, only fps"):
        read_rig(path)
