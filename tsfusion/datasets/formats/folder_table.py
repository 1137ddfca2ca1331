# SPDX-License-Identifier: MIT
"""Define the known layouts of folders with depth images: attributes for each, and methods for exceptions."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import DepthUnit, PublishedCamera
from tsfusion.datasets.dataset import SCAN, WITHOUT_DEPTH, FramePoses, NoPoses, Times
from tsfusion.datasets.file_names import in_order, in_time, numbers_in, series_of
from tsfusion.datasets.formats.image_folders import (
    COLOR,
    DepthImages,
    ImagesAt,
    PoseFiles,
    PoseRows,
    depth_images,
    poses_by_number,
    resample_for_camera,
)
from tsfusion.datasets.formats.image_folders import SUFFIXES as COLOR_SUFFIXES
from tsfusion.datasets.readers import DEPTH_SUFFIXES, intrinsics_of, read_color, read_numbers
from tsfusion.datasets.trajectory_files import is_log, read_log
from tsfusion.geometry.keyframe import Intrinsics

PLAIN_EXPECTED = (
    "depth/*.png, .tiff, .exr or .npy and color/, colour/, rgb/, image/ or images/, of equal names, or all "
    "in one folder (depth_N.png and color_N.png, N-depth.png and N-rgb.jpg, …), and camera-intrinsics.txt or "
    "camera_intrinsic.json; without poses, so for a scan, or with --trajectory"
)
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0)  # published with the data
_SCENES = re.compile(r"chess|fire|heads|office|pumpkin|redkitchen(_\w+)?|stairs")
_RELEASE = re.compile(r"7[-_]?scenes|seven[-_]?scenes", re.IGNORECASE)
_RELEASED = ("TrainSplit.txt", "TestSplit.txt")  # in every scene's folder
NOT_MEASURED = 65535  # invalid depth in the original release; 0 in re-encoded copies
# Open3D's PrimeSenseDefault, for recordings distributed by Redwood and Open3D
_PRIMESENSE = PublishedCamera("Redwood's recordings", Intrinsics(525.0, 525.0, 319.5, 239.5))
_REDWOODS_NAMES = re.compile(
    r"redwood[-_](sample|lounge|bedroom|living_?room\d|office\d)|(lounge|bedroom|sampleredwood)rgbdimages"
    r"|open3d[-_]rgbd|augmented[-_]icl"
)
_REDWOODS_FILES = ("livingroom[12]-traj.txt", "office[12]-traj.txt")
_IMAGES = {*DEPTH_SUFFIXES, *COLOR_SUFFIXES}
_LOGS = ("trajectory.log", "scene/trajectory.log", "odometry.log")  # by preference
_LOG_NAMES = ("*traj*.log", "*-traj.txt")
# In the name of a depth image with its colour image in the same folder: depth_3, depth16_3, depth_raw_3
_DEPTH = re.compile("depth(?:16(?=[_-])|[_-]?raw)?", re.IGNORECASE)
_FEWEST = 2  # images of a series
_CAMERAS = ("intrinsic/intrinsic_{}.txt", "intrinsics_{}.txt", "intrinsic_{}.txt")  # ScanNet's


class SevenScenes(DepthImages):
    """A scene (every `seq-*` in it, with one world) or a single sequence.

    Depth is uint16 millimetres. The colour of 7-Scenes has the depth's size, but comes from another camera
    and is up to 35 pixels off; 3DMatch's is registered. There are no timestamps (nominally 30 Hz).

    Args:
        path: folder of the scene or the sequence. A camera file may be beside the frames or up to two folders
            up. Without one, a scene of 7-Scenes (known by its name and `TrainSplit.txt`, or by a folder
            `7scenes`) at 640×480 has fx fy cx cy = 585 585 320 240.
        options: those of `DepthImages`.
    """

    layout, not_measured = "7-Scenes", NOT_MEASURED
    expected = (
        "frame-XXXXXX.{depth.png,pose.txt,color.png|jpg}, in the folder or in its seq-XX folders, and "
        "camera-intrinsics.txt unless it is a scene of 7-Scenes"
    )
    signs = (("frame-*.depth.png", "seq-*/frame-*.depth.png"),)
    depth_at = ImagesAt(("",), "frame-{}.depth")
    color_at = ImagesAt(("",), "frame-{}.color")
    poses_at = PoseFiles("frame-{}.pose.txt")

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        files: list[Path] = []
        for sequence in _sequences(root):
            depth = _frames(sequence, "depth.png")
            alone = _frames(sequence, "pose.txt") - depth
            if len(alone) > len(depth):
                raise DatasetError(
                    f"{sequence / min(alone)}.depth.png is missing, but its pose.txt is there; "
                    f"expected {self.expected}"
                )
            if alone:
                self.skipped[WITHOUT_DEPTH] = self.skipped.get(WITHOUT_DEPTH, 0) + len(alone)
            files += in_order(sequence / f"{stem}.depth.png" for stem in depth)
        return files, None

    def _colors(self, root: Path) -> list[Path]:
        folder = self._files[0].parent
        kinds = [kind for kind in ("color.png", "color.jpg") if any(folder.glob(f"frame-*.{kind}"))]
        named = [(file, file.name.removesuffix("depth.png")) for file in self._files]
        return [file.with_name(stem + kind) for kind in kinds[:1] for file, stem in named]

    def _known_camera(self, root: Path) -> dict[str, Any]:
        published = PublishedCamera("7-Scenes", KINECT) if _is_seven_scenes(root) else None
        places = (self._files[0].parent, root, root.absolute().parent)
        return {"places": places, "published": published}


class ScanNet(DepthImages):
    """A scene as exported by ScanNet's SensReader, or one of `scannet_frames_25k`.

    http://www.scan-net.org. Depth is uint16 millimetres. The colour camera is beside the depth camera and has
    other pixels: colour is resampled with both cameras' matrices, as if the cameras had one position. Frames
    that the authors' tracker lost have poses of -inf: they count as frames without a pose. No timestamps
    (nominally 30 Hz). Options are those of `DepthImages`.
    """

    layout = "ScanNet"
    expected = "color/N.jpg, depth/N.png, pose/N.txt and intrinsic/intrinsic_{depth,color}.txt"
    camera_at = tuple(name.format("depth") for name in _CAMERAS)
    signs = (("depth",), ("intrinsic", "pose"), camera_at)
    color_at = ImagesAt(("color",))
    poses_at = PoseFiles("pose/{}.txt")

    def _colors(self, root: Path) -> Sequence[Path | None]:
        self.color_intrinsics = _color_intrinsics(root)
        return super()._colors(root)

    def _registered(self, color: Path, depth: NDArray[Any]) -> NDArray[np.uint8]:
        if self.color_intrinsics is None:
            return super()._registered(color, depth)
        image, own = read_color(color, None), self.color_intrinsics
        height, width = image.shape[:2]
        if not (0.25 < own.cx / width < 0.75 and 0.25 < own.cy / height < 0.75):
            raise DatasetError(
                f"{color} is {width}×{height}, and the colour camera's matrix with cx {own.cx:g}, "
                f"cy {own.cy:g} is of images of another size: give that of these (intrinsic_color.txt), or "
                "leave colour out (--option color=false)"
            )
        return resample_for_camera(image, own, self.intrinsics, depth.shape)


class Replica(DepthImages):
    """A scene of Replica as distributed with NICE-SLAM (also used by many later SLAM systems).

    https://github.com/cvg/nice-slam. Line k of `traj.txt` is frame k's 4×4 camera-to-world matrix, OpenCV
    axes. Depth has 6553.5 units for each metre, at 1200×680 with K 600, 600, 599.5, 339.5, unless
    `cam_params.json` states otherwise. The images are rendered, without noise or timestamps. Options are
    those of `DepthImages`.
    """

    layout = "Replica"
    expected = (
        "traj.txt, results/depthN.png and results/frameN.jpg, with cam_params.json there or one folder up"
    )
    signs = (("results/depth*.png",),)
    depth_at, color_at = ImagesAt(("results",), "depth{}"), ImagesAt(("results",), "frame{}")
    poses_at = PoseRows("traj.txt", by_number=True)
    camera_at = ("cam_params.json", "../cam_params.json")
    published = PublishedCamera("NICE-SLAM's Replica", Intrinsics(600.0, 600.0, 599.5, 339.5), (680, 1200))
    usual_unit = DepthUnit(1 / 6553.5, "usual for NICE-SLAM's Replica", is_stated=False)


class HoloLens(DepthImages):
    """HoloLens RGB-D as in deep-video-mvs: line k of `poses.txt` belongs to the k-th image by name.

    https://github.com/ardaduz/deep-video-mvs. Depth is time-of-flight in uint16 millimetres, registered to
    colour. There are no timestamps. Options are those of `DepthImages`.
    """

    layout, expected, sensor = "HoloLens", "K.txt, poses.txt, depth/*.png and images/*.png", "tof"
    signs = (("K.txt",), ("depth",), ("poses.txt", "images"))
    color_at = ImagesAt(("images",))
    poses_at = PoseRows("poses.txt")


class Redwood(DepthImages):
    """Redwood's data sets and Open3D's reconstructions: a `.log` of poses, depth in uint16 millimetres.

    http://redwood-data.org and Open3D's reconstruction system. The folders are `depth/` beside `color/`,
    `image/` or others, or Redwood's own `NAME-depth-clean/`, `NAME-color/`, `NAME-traj.txt`. A pose belongs
    to the image with its number in the file name. If there are as many poses as images but with other
    numbers, the k-th pose belongs to the k-th image. Poses without an image are ignored. Images named by
    seconds or nanoseconds have times, others have none.

    Args:
        path: the folder, or the `.log` in it with the poses to take.
        trajectory: default `trajectory.log`, `scene/trajectory.log`, `odometry.log` or the only file named
            `*traj*.log` or `*-traj.txt`.
        intrinsics, calibration: default a camera file in the folder (`cameras.FILES`); else 525, 525, 319.5,
            239.5 at 640×480 for recordings distributed by Redwood and Open3D, known by their names.

    Other options are those of `DepthImages`.
    """

    layout, guesses = "Redwood", True
    expected = (
        "depth/*.png, .tiff, .exr or .npy, color/, colour/, rgb/, image/ or images/, camera-intrinsics.txt "
        "or camera_intrinsic.json, and trajectory.log, odometry.log or *-traj.txt"
    )
    depth_at, color_at = ImagesAt(("depth", "*-depth*")), ImagesAt((*COLOR, "*-color"))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with depth images and a trajectory, and for the `.log` file in it."""
        if path.is_file():
            return path.suffix == ".log" and _root_of(path) is not None
        return bool(cls.depth_at.folders(path)) and _log(path) is not None

    @classmethod
    def recognises_plain(cls, path: Path) -> bool:
        """Return True for a folder with a depth and a colour folder, or with both kinds of image inside."""
        if cls.depth_at.folders(path):
            return bool(cls.color_at.folders(path))
        return bool(_beside(path))

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        path = Path(path).expanduser()
        if path.is_file():
            path, trajectory = _root_of(path) or path.parent, trajectory or path.absolute()
        self.root, given = super()._opened(path, trajectory)
        return self.root, given

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        folders = self.depth_at.folders(root)
        if len(folders) > 1:
            names = ", ".join(path.name for path in folders)
            raise DatasetError(
                f"{root} holds {len(folders)} depth folders ({names}); name the one to use depth/"
            )
        self._beside = {} if folders else _only_series(root)
        files = [*self._beside] or depth_images(root, self.depth_at, self.expected)
        return in_time(files, _names(files))

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        path = _log(root)
        if path is None:
            given = root / "groundtruth.txt"  # in TUM's layout
            hint = f"{SCAN}, or --trajectory {given} names them" if given.is_file() else SCAN
            raise NoPoses(f"{root} has no trajectory; expected {self.expected}; {hint}")
        return self._poses_of(path, files)

    def _poses_of(self, path: Path, files: list[Path]) -> FramePoses:
        """Return the poses of a `.log` by number; of another trajectory by time, or one for each image."""
        if is_log(path):
            return poses_by_number(_names(files), read_log(path), path)
        return super()._poses_of(path, files)

    def _colors(self, root: Path) -> Sequence[Path | None]:
        if self._beside:
            return [self._beside[file] for file in self._files]
        return super()._colors(root) if self.color_at.folders(root) else []

    def _known_camera(self, root: Path) -> dict[str, Any]:
        published = _PRIMESENSE if _is_redwoods(root) else None
        return {"places": (root, self._files[0].parent), "published": published}


def _sequences(root: Path) -> list[Path]:
    """Return the folder itself if it holds frames, else its `seq-*` folders."""
    if _frames(root, "depth.png") or _frames(root, "pose.txt"):
        return [root]
    return in_order(path for path in root.glob("seq-*") if path.is_dir())


def _frames(sequence: Path, suffix: str) -> set[str]:
    return {path.name[: -len(suffix) - 1] for path in sequence.glob(f"frame-*.{suffix}")}


def _is_seven_scenes(root: Path) -> bool:
    """Return True for a scene or sequence of 7-Scenes, not just a folder with such a name."""
    root = root.resolve()
    names = root.parts[-3:]
    scene = next((place for place in (root, root.parent) if _SCENES.fullmatch(place.name)), None)
    if scene is None:
        return False
    return any(map(_RELEASE.search, names)) or any((scene / name).is_file() for name in _RELEASED)


def _color_intrinsics(root: Path) -> Intrinsics | None:
    names = (name.format("color") for name in _CAMERAS)
    path = next((root / name for name in names if (root / name).is_file()), None)
    if path is None:
        return None
    K = read_numbers(path, "a 4×4 or 3×3 camera matrix")
    if K.shape not in ((4, 4), (3, 3)):
        raise DatasetError(f"{path} must hold a 4×4 or 3×3 camera matrix, got {K.shape[0]}×{K.shape[1]}")
    return intrinsics_of(K, path)


def _names(files: list[Path]) -> list[str]:
    """Return the images' names without suffix; or only the number in each, if it stands beside "depth"."""
    numbers = [numbers_in(_DEPTH.sub("", file.stem)) for file in files if _DEPTH.search(file.stem)]
    is_numbered = len(numbers) == len(files) and all(len(one) == 1 for one in numbers)
    return [one[0] for one in numbers] if is_numbered else [file.stem for file in files]


def _only_series(root: Path) -> dict[Path, Path | None]:
    """Return each depth image's colour image (or None) in the same folder, in order.

    Raises:
        DatasetError: there are several series.
    """
    found = _beside(root)
    if len(found) > 1:
        names = " and ".join(next(iter(one)).name for one in found)
        raise DatasetError(f"{root} holds several series of depth images ({names}, …); move the others away")
    return found[0] if found else {}


def _beside(root: Path) -> list[dict[Path, Path | None]]:
    """Return each series of depth images in a folder with its colour images, known by their names."""
    if not root.is_dir():
        return []
    files = {file.name.lower(): file for file in root.glob("[!.]*") if file.suffix.lower() in _IMAGES}
    deep = (file for file in files.values() if file.suffix.lower() in DEPTH_SUFFIXES)
    named = [file for file in deep if _DEPTH.search(file.stem)]
    found = []
    for series in series_of(named):
        pairs = {file: _partner(file, files) for file in series}
        if len(series) - list(pairs.values()).count(None) >= _FEWEST and _is_deep(series[0]):
            found.append(pairs)
    return found


def _partner(depth: Path, files: dict[str, Path]) -> Path | None:
    """Return the colour image whose name has "color" where the depth image's name has "depth", or None."""
    stems = (_DEPTH.sub(word, depth.stem).lower() for word in COLOR)
    names = (stem + suffix for stem in stems for suffix in COLOR_SUFFIXES)
    return next((files[name] for name in names if name in files), None)


def _is_deep(file: Path) -> bool:
    """Return True if a file may hold depth: a PNG of one 16-bit channel, or any other format."""
    if file.suffix.lower() != ".png":
        return True
    try:
        with file.open("rb") as opened:
            return opened.read(26)[24:26] == b"\x10\0"
    except OSError:
        return False


def _root_of(log: Path) -> Path | None:
    """Return the recording that a trajectory belongs to: `scene/trajectory.log` is one folder down."""
    log = log.absolute()
    places = (log.parent, log.parent.parent)
    return next((place for place in places if Redwood.depth_at.folders(place) or _beside(place)), None)


def _log(root: Path) -> Path | None:
    known = [root / name for name in _LOGS if (root / name).is_file()]
    named = [path for pattern in _LOG_NAMES for path in sorted(root.glob(pattern)) if path.is_file()]
    return next((path for path in [*known, *named] if not path.name.startswith(".")), None)


def _is_redwoods(root: Path) -> bool:
    names = "/".join(root.resolve().parts[-2:]).lower()
    return bool(_REDWOODS_NAMES.search(names)) or any(any(root.glob(name)) for name in _REDWOODS_FILES)
