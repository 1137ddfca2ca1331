# SPDX-License-Identifier: MIT
"""The camera of a recording: as given, from its files, or as published; never a guess."""

import json
from pathlib import Path

import numpy as np
import own_recordings
import pytest
from geometry_checks import warp_residual
from own_recordings import KINECT
from small_recordings import CAMERA, corbs, hololens, kitti, one_line, redwood, seven_scenes
from written_recordings import check, matrix, millimetres, scannet, through_lens, transforms, views, write

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import TUM, Redwood, describe, open_dataset, select
from tsfusion.datasets.cameras import camera_line
from tsfusion.datasets.formats.folder_table import KINECT as SEVEN_SCENES
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.source import RecordedSource
from tsfusion.scanner.sources.watched_folder import WatchedFolder

GIVEN = Intrinsics(585, 585, 320, 240)
PRIMESENSE = Intrinsics(525, 525, 319.5, 239.5)  # which was taken for the camera of both
UNKNOWN = r"the camera of these \d+×\d+ images is not known.*K\.txt.*; give --intrinsics fx,fy,cx,cy or --cal"


@pytest.fixture
def kitchen(data):
    return data("7scenes/redkitchen")


@pytest.mark.parametrize("make", [own_recordings.images, own_recordings.tum])
def test_a_folder_of_ones_own_without_a_camera_is_an_error(tmp_path, kitchen, make):
    root = make(tmp_path / "mine", own_recordings.views(kitchen), camera=False)
    for posed in (True, False):
        one_line(lambda posed=posed: open_dataset(root, posed=posed), UNKNOWN)
    right, wrong = open_dataset(root, intrinsics=GIVEN), open_dataset(root, intrinsics=PRIMESENSE)
    assert str(right.camera) == "fx 585 fy 585 cx 320 cy 240, 640×480, as given"
    assert right[0].intrinsics == GIVEN
    assert warp_residual(right[0], right[2]) < 0.02 < warp_residual(wrong[0], wrong[2])


@pytest.mark.parametrize("make", [own_recordings.images, own_recordings.tum])
@pytest.mark.parametrize("name", ["camera-intrinsics.txt", "K.txt", "depth/intrinsics.txt"])
def test_the_camera_file_in_a_folder_of_ones_own_counts(tmp_path, kitchen, make, name):
    root = make(tmp_path / "mine", own_recordings.views(kitchen, 1), camera=False)
    (root / name).write_text(KINECT)
    dataset = open_dataset(root)
    assert dataset.intrinsics == dataset[0].intrinsics == GIVEN
    assert describe(dataset).endswith(f"; camera fx 585 fy 585 cx 320 cy 240, 640×480, from {name}")


K = {"fx": 9.0, "fy": 8.0, "ppx": 4.0, "ppy": 3.0, "width": 8, "height": 6}
COLUMNS = [9, 0, 0, 0, 8, 0, 4, 3, 1]  # Open3D's order
FILES = {
    "camera-intrinsics.txt": "9 0 4\n0 8 3\n0 0 1\n",
    "k.txt": "# depth\r\n9, 0, 4\r\n0, 8, 3\r\n0, 0, 1\r\n",
    "intrinsic.txt": matrix(np.array([[9, 0, 4, 0], [0, 8, 3, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])),
    "intrinsics_depth.txt": "[[9 0 4]\n [0 8 3]\n [0 0 1]]\n",
    "calibration.txt": "9 8 4 3\n8 6\n",
    "calib.txt": "fx: 9\nfy: 8\ncx: 4\ncy: 3\n",
    "camera_intrinsic.json": json.dumps({"width": 8, "height": 6, "intrinsic_matrix": COLUMNS}),
    "camera_primesense.json": json.dumps({"intrinsic": {"intrinsic_matrix": COLUMNS}}),
    "intrinsic.json": json.dumps({"intrinsic_matrix": [[9, 0, 4], [0, 8, 3], [0, 0, 1]]}),
    "depth_intrinsics.json": json.dumps({"depth": {**K, "coeffs": [0.0] * 5, "model": "distortion.none"}}),
    "camera.yaml": "camera_model: pinhole\nintrinsics: [9, 8, 4, 3]\ndistortion_model: none\n"
    "distortion_coeffs: []\nresolution: [8, 6]\n",
    "camera_info.yaml": "height: 6\nwidth: 8\ndistortion_model: plumb_bob\nd: [0.0, 0.0, 0.0, 0.0, 0.0]\n"
    "k: [9.0, 0.0, 4.0, 0.0, 8.0, 3.0, 0.0, 0.0, 1.0]\n",
    "Camera.yml": "%YAML:1.0\nCamera.fx: 9.0\nCamera.fy: 8.0\nCamera.cx: 4.0\nCamera.cy: 3.0\n"
    "Camera.k1: 0.0\nCamera.width: 8\nCamera.height: 6\n",
}  # fmt: skip


UNITS = {
    "camera_intrinsic.json": (json.dumps({"intrinsic_matrix": COLUMNS, "depth_scale": 2000.0}), 1 / 2000),
    "intrinsic.json": (json.dumps({"depth_scale": 0.0001, "depth": {**K, "model": "none"}}), 0.0001),
    "cam_params.json": (json.dumps({"camera": {**K, "cx": 4, "cy": 3, "scale": 6553.5}}), 1 / 6553.5),
    "camera.json": (json.dumps({**K, "depth": {"scale": 4000}}), 1 / 4000),
    "camera_info.json": (json.dumps({**K, "depth_units": "mm"}), 0.001),
    "Camera.yml": ("Camera.fx: 9.0\nCamera.cx: 4.0\nCamera.cy: 3.0\nDepthMapFactor: 5000.0\n", 1 / 5000),
    "calibration.yaml": ("cam:\n  fx: 9\n  fy: 8\n  cx: 4\n  cy: 3\n  png_depth_scale: 6553.5\n", 1 / 6553.5),
    "calib.txt": ("fx: 9\nfy: 8\ncx: 4\ncy: 3\ndepth_factor: 5000\n", 1 / 5000),
    "camera_param.json": (json.dumps({**K, "scale": 1.0, "depth_trunc": 3, "depth_scale": None}), 0.001),
}  # fmt: skip


@pytest.mark.parametrize("name", UNITS)
def test_the_unit_of_depth_in_a_file_of_the_camera_counts(tmp_path, name):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").unlink()
    text, metres = UNITS[name]
    (root / name).write_text(text)
    source = "as usual" if name == "camera_param.json" else f"from {name}"
    given = {"intrinsics": Intrinsics(9, 8, 4, 3)}
    for options in ({}, given):
        dataset = open_dataset(root, **options)
        assert dataset[0].depth_scale == pytest.approx(metres, rel=1e-12)
        assert (
            f"; depth unit {1000 * metres:.4g} mm ({1 / metres:.6g} a metre), {source}; camera "
            in describe(dataset)
        )
    assert open_dataset(root, depth_scale=0.01)[0].depth_scale == 0.01
    folder = WatchedFolder(root, idle=0.1)
    assert next(iter(folder)).depth_scale == pytest.approx(metres, rel=1e-12)
    assert source in folder.camera


@pytest.mark.parametrize("make", [seven_scenes, hololens, corbs, scannet])
def test_every_layout_heeds_the_unit_of_depth_that_is_given(tmp_path, make):
    root = make(tmp_path / "recording")
    calibration = tmp_path / "given.json"
    height, width = (frame := open_dataset(root, posed=False).frame(0)).shape
    assert frame.depth_scale in (0.001, 1 / 5000)
    K = {"fx": width, "cx": width / 2, "cy": height / 2, "width": width, "height": height}
    calibration.write_text(json.dumps({**K, "depth_scale": 2000}))
    assert open_dataset(root, posed=False, calibration=calibration).frame(0).depth_scale == 1 / 2000
    assert open_dataset(root, posed=False, depth_scale=0.004).frame(0).depth_scale == 0.004


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"depth_scale": 0}, r"intrinsic\.json: depth_scale is no unit of depth; expected metres a unit"),
        ({"depth_scale": "soon"}, "depth_scale is no unit of depth"),
        ({"depth_scale": 0.5}, "depth_scale is no unit of depth"),
        ({"depth_scale": 1e9}, "depth_scale is no unit of depth"),
        ({"depth_scale": 1000, "depth_units": 0.0002}, "several units of depth: depth_scale, depth_units"),
    ],
)
def test_a_unit_of_depth_that_is_none_is_refused(tmp_path, stated, message):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").unlink()
    (root / "intrinsic.json").write_text(json.dumps({**K, **stated}))
    one_line(lambda: open_dataset(root), message)
    (root / "intrinsic.json").write_text(json.dumps({**K, "depth_scale": 1000}))
    (root / "camera.json").write_text(json.dumps({**K, "depth_scale": 5000}))
    one_line(
        lambda: open_dataset(root), "two units of depth contradict each other: 0.0002 m of .*, 0.001 m of"
    )


SKEWED = {
    "K.txt": "9 2 4\n0 8 3\n0 0 1\n",
    "calib.txt": "fx: 9\nfy: 8\ncx: 4\ncy: 3\nskew: 2\n",
    "camera_intrinsic.json": json.dumps({"intrinsic_matrix": [9, 0, 0, 2, *COLUMNS[4:]]}),
    "camera_info.yaml": "height: 6\nwidth: 8\nk: [9.0, 2.0, 4.0, 0.0, 8.0, 3.0, 0.0, 0.0, 1.0]\n",
}  # fmt: skip


@pytest.mark.parametrize("name", SKEWED)
def test_skew_of_a_camera_matrix_is_used(tmp_path, name):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").unlink()
    (root / name).write_text(SKEWED[name])
    camera = open_dataset(root).camera
    assert (camera.lens.skew, camera.lens.intrinsics) == (2.0, Intrinsics(9, 8, 4, 3))
    assert str(camera).endswith("undistorted (skew 2 px)")


@pytest.mark.parametrize("name", FILES)
def test_every_usual_file_of_a_camera_is_read(tmp_path, name):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").unlink()
    (root / name).write_text(FILES[name])
    assert open_dataset(root).intrinsics == Intrinsics(9, 8, 4, 3)
    given = open_dataset(root, calibration=root / name)
    assert given.intrinsics == Intrinsics(9, 8, 4, 3)
    assert str(given.camera).endswith(f", 8×6, from the given {name}")


def test_what_is_given_beats_the_file(tmp_path):
    root = redwood(tmp_path, [0], [0])
    (root / "other.txt").write_text("7 7 4 3\n")
    assert open_dataset(root).intrinsics.fx == 5
    assert open_dataset(root, calibration=root / "other.txt").intrinsics.fx == 7
    assert open_dataset(root, intrinsics=[6, 6, 4, 3]).intrinsics.fx == 6
    both = {"calibration": root / "other.txt", "intrinsics": [6, 6, 4, 3]}
    one_line(lambda: open_dataset(root, **both), "exclude each other")
    one_line(lambda: open_dataset(root, calibration=root / "none.txt"), r"none\.txt is missing; expected Kal")


def test_two_files_must_not_contradict_each_other(tmp_path):
    root = redwood(tmp_path, [0], [0])
    (root / "camera.yaml").write_text("intrinsics: [5.1, 5, 4, 3]\nresolution: [8, 6]\n")
    assert open_dataset(root).camera.source == "from camera-intrinsics.txt"
    (root / "camera.yaml").write_text("intrinsics: [6, 6, 4, 3]\nresolution: [8, 6]\n")
    match = r"contradict each other: .*camera-intrinsics\.txt says fx 5 .*camera\.yaml says fx 6 .*; remove"
    one_line(lambda: open_dataset(root), match)
    assert open_dataset(root, intrinsics=[6, 6, 4, 3]).intrinsics.fx == 6


def test_the_colour_camera_is_not_the_depth_camera(tmp_path):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").rename(root / "intrinsic_color.txt")
    one_line(lambda: open_dataset(root), r"color\.txt is of the colour camera, .* give --calibration")
    (root / "intrinsic_depth.txt").write_text("7 0 4\n0 7 3\n0 0 1\n")
    assert open_dataset(root).intrinsics.fx == 7


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("5 0 0\n0 5 0\n4 3 1\n", r"must end with 0 0 1, got .*: it is transposed"),
        ("5 0 8\n0 5 3\n0 0 1\n", r"cx 8 lies outside of the images, which are 8×6"),
        ("5 5 4 6\n", r"cy 6 lies outside of the images"),
        ("585 0 320\n0 585 240\n0 0 1\n", r"cx 320 lies outside of the images, .*of another size"),
        ("0 0 4\n0 5 3\n0 0 1\n", r"intrinsics must be finite with fx > 0"),
        ("5 0 4\n0 nan 3\n0 0 1\n", r"must be finite"),
        ("5 0 4\n1 5 3\n0 0 1\n", r"must end with 0 0 1"),
        ("hello\n", r"could not convert .*; expected .* 3×3 matrix, or fx fy cx cy"),
        ("", r"0 numbers; expected"),
        ("1 2 3 4 5\n", r"5 numbers; expected"),
        ("5 5 4 3\n16 9\n", r"of images of 16×9, but these are 8×6, of another aspect ratio"),
    ],
)
def test_a_camera_file_that_cannot_be_right_is_one_clear_line(tmp_path, text, match):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").write_text(text)
    one_line(lambda: open_dataset(root), match)


def test_a_calibration_of_another_size_is_scaled_where_the_shape_is_the_same(tmp_path):
    root = redwood(tmp_path, [0], [0])
    (root / "camera-intrinsics.txt").write_text("10 10 8.5 6.5\n16 12\n")
    dataset = open_dataset(root)
    assert dataset.intrinsics == Intrinsics(5, 5, 4, 3)
    assert dataset.camera.source == "from camera-intrinsics.txt scaled from 16×12"


SIZE = (120, 160)
LENS = {
    "radtan": Camera(Intrinsics(146.25, 146.25, 79.5, 59.5), SIZE, "radtan", (-0.2, 0.03, 0.001, -0.001)),
    "equidistant": Camera(Intrinsics(130, 130, 79.5, 59.5), SIZE, "equidistant", (0.02, -0.01, 0.0, 0.0)),
}


def distorted(root: Path, lens: Camera, *, tum: bool) -> Path:
    """The room through a lens, as a TUM or a Redwood recording, with its calibration beside the folder."""
    log, lists = "", {"depth": "", "rgb": ""}
    for number, view in enumerate(views()):
        images = {"depth": millimetres(view) * (5 if tum else 1), "rgb": view.color}
        for name, image in images.items():
            write(root / name / f"{number}.png", through_lens(image, view.intrinsics, lens))
            lists[name] += f"{number} {name}/{number}.png\n"
        log += f"{number} {number} {number + 1}\n{matrix(view.T_world_camera)}"
    if tum:
        for name, text in lists.items():
            (root / f"{name}.txt").write_text(text)
        from tsfusion.datasets.trajectory_files import write_tum

        stamps = [10**9 * number for number in range(len(views()))]
        write_tum(root / "groundtruth.txt", stamps, [view.T_world_camera for view in views()])
    else:
        (root / "trajectory.log").write_text(log)
    k = lens.intrinsics
    (root.parent / "lens.yaml").write_text(
        f"camera_model: pinhole\nintrinsics: [{k.fx}, {k.fy}, {k.cx}, {k.cy}]\nresolution: [160, 120]\n"
        f"distortion_model: {lens.model}\ndistortion_coeffs: {list(lens.distortion)}\n"
    )
    return root


@pytest.mark.parametrize("model", LENS)
@pytest.mark.parametrize("tum", [False, True])
def test_the_distortion_of_a_lens_is_removed(tmp_path, model, tum):
    root = distorted(tmp_path / "lens", LENS[model], tum=tum)
    dataset = open_dataset(root, calibration=tmp_path / "lens.yaml")
    assert str(dataset.camera).endswith("from the given lens.yaml, undistorted")
    a, b = dataset[0], dataset[1]
    assert a.intrinsics == dataset.intrinsics != LENS[model].intrinsics
    assert warp_residual(a, b) < 0.006
    flat = Camera(dataset.intrinsics, (120, 160))
    expected = through_lens(views()[0].color, views()[0].intrinsics, flat)
    difference = np.abs(a.color.astype(int) - expected)[a.depth > 0]
    assert np.median(difference) <= 2
    (tmp_path / "lens.yaml").rename(root / "camera.yaml")
    assert open_dataset(root).camera.source == "from camera.yaml"


def test_nerfstudio_takes_a_given_camera(tmp_path):
    file, K = transforms(tmp_path) / "transforms.json", views()[0].intrinsics
    assert str(open_dataset(tmp_path).camera).endswith("160×120, from transforms.json")
    file.write_text(file.read_text().replace(f'"fl_x": {K.fx}', '"fl_x": 99.0'))
    assert open_dataset(tmp_path)[0].intrinsics.fx == 99
    check(open_dataset(tmp_path, intrinsics=K), views())


# --- benchmarks ---


def test_the_published_camera_is_for_the_benchmarks_own_recordings(tmp_path):
    """Also for those of another size it is none; and a name that anybody may give is not enough."""
    for name in ("office", "7scenes/mine", "office/seq-01"):
        root = seven_scenes(tmp_path / name, 1, (480, 640))
        (root / "camera-intrinsics.txt").unlink()
        one_line(lambda root=root: open_dataset(root), UNKNOWN)
    root = seven_scenes(tmp_path / "7scenes" / "office" / "seq-01", 1, (480, 640))
    (root / "camera-intrinsics.txt").unlink()
    scene = seven_scenes(tmp_path / "chess" / "seq-02", 1, (480, 640)).parent
    (scene / "seq-02" / "camera-intrinsics.txt").unlink()
    (scene / "TrainSplit.txt").write_text("sequence2\n")
    for place in (root, root.parent, scene, scene / "seq-02"):
        dataset = open_dataset(place)
        assert dataset.intrinsics == SEVEN_SCENES
        assert dataset.camera.source == "published for 7-Scenes"
    half = seven_scenes(tmp_path / "7scenes" / "fire", 1, (240, 320))
    (half / "camera-intrinsics.txt").unlink()
    one_line(lambda: open_dataset(half), r"that of 7-Scenes is published for 640×480 alone")


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("redwood-livingroom1", True), ("LoungeRGBDImages", True), ("open3d_rgbd", True),
        ("mine", False), ("redwood", False), ("office1", False), ("my_open3d_scan", False),
    ],
)  # fmt: skip
def test_primesense_is_for_what_redwood_distributes(tmp_path, name, known):
    root = redwood(tmp_path / name, [0], [0])
    (root / "camera-intrinsics.txt").unlink()
    for folder, channels in (("depth", ()), ("color", (3,))):
        dtype = np.uint8 if channels else np.uint16
        write(root / folder / "00000.png", np.ones((480, 640, *channels), dtype))
    if known:
        assert Redwood(root).camera.source == "published for Redwood's recordings"
        assert Redwood(root).intrinsics == PRIMESENSE
    else:
        one_line(lambda: Redwood(root), UNKNOWN)


def test_windows_paths_do_not_make_a_recording_corbs(tmp_path):
    root = corbs(tmp_path).rename(tmp_path / "D1_mine")
    one_line(lambda: TUM(root, trajectory=tmp_path / "D1_Trajectory" / "groundtruth.txt"), UNKNOWN)


def test_other_layouts_say_that_they_take_no_camera(tmp_path):
    root = kitti(tmp_path)
    one_line(lambda: open_dataset(root, intrinsics=[1, 1, 1, 1]), "leave out --intrinsics")
    with pytest.raises(DatasetError, match=r"a synthetic dataset has a camera of its own: leave out --cal"):
        open_dataset("synthetic:room", calibration="a.yaml")


def test_the_present_folder_has_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(redwood(tmp_path / "yard", [0], [0]))
    assert open_dataset(".").name == "Redwood yard"


def test_a_selection_and_any_dataset_name_their_camera(tmp_path):
    root = redwood(tmp_path, [0, 1], [0, 1])
    assert (root / "camera-intrinsics.txt").read_text() == CAMERA
    line = "fx 5 fy 5 cx 4 cy 3, 8×6, from camera-intrinsics.txt"
    assert camera_line(select(open_dataset(root), start=1)) == line
    assert camera_line(open_dataset(kitti(tmp_path / "kitti"), modality="lidar")) == ""
    room = open_dataset("synthetic:room", width=64)
    assert camera_line(room) == "fx 58.5 fy 58.5 cx 31.5 cy 23.5, 64×48, from its frames"
    assert RecordedSource(room).camera == ""  # of no file: a scan says what its frames have
    assert RecordedSource(open_dataset(root)).camera == line
