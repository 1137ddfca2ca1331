# SPDX-License-Identifier: MIT
"""RGB-D folders with one pose file: HoloLens recordings and Redwood / Open3D reconstructions."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import PublishedCamera
from tsfusion.datasets.dataset import SCAN, NoPoses, Poses, Times
from tsfusion.datasets.depth_files import SUFFIXES
from tsfusion.datasets.file_names import in_time, numbers_in, series_of
from tsfusion.datasets.formats.image_folders import (
    COLOR,
    DepthImages,
    color_images,
    depth_images,
    poses_by_number,
)
from tsfusion.datasets.formats.image_folders import SUFFIXES as COLOR_SUFFIXES
from tsfusion.datasets.trajectory_files import is_log, read_log, read_matrix_rows
from tsfusion.geometry.keyframe import Intrinsics

HOLOLENS_EXPECTED = "K.txt, poses.txt, depth/*.png and images/*.png"
REDWOOD_EXPECTED = (
    "depth/*.png, .tiff, .exr or .npy, color/, colour/, rgb/, image/ or images/, camera-intrinsics.txt or "
    "camera_intrinsic.json, and trajectory.log, odometry.log or *-traj.txt"
)
PLAIN_EXPECTED = (
    "depth/*.png, .tiff, .exr or .npy and color/, colour/, rgb/, image/ or images/, of equal names, or all "
    "in one folder (depth_N.png and color_N.png, N-depth.png and N-rgb.jpg, …), and camera-intrinsics.txt or "
    "camera_intrinsic.json; without poses, so for a scan, or with --trajectory"
)
# Open3D's PrimeSenseDefault, for the recordings that Redwood and Open3D distribute
_PRIMESENSE = PublishedCamera("Redwood's recordings", Intrinsics(525.0, 525.0, 319.5, 239.5))
_REDWOODS_NAMES = re.compile(
    r"redwood[-_](sample|lounge|bedroom|living_?room\d|office\d)|(lounge|bedroom|sampleredwood)rgbdimages"
    r"|open3d[-_]rgbd|augmented[-_]icl"
)
_REDWOODS_FILES = ("livingroom[12]-traj.txt", "office[12]-traj.txt")
_IMAGES = {*SUFFIXES, *COLOR_SUFFIXES}
_LOGS = ("trajectory.log", "scene/trajectory.log", "odometry.log")  # by preference
_LOG_NAMES = ("*traj*.log", "*-traj.txt")
# In the name of an image that has its colour beside it: depth_3, depth16_3, depth_raw_3
_DEPTH = re.compile("depth(?:16(?=[_-])|[_-]?raw)?", re.IGNORECASE)
_FEWEST = 2  # images of a series


def recognises_hololens(path: Path) -> bool:
    """True for a folder with `K.txt`, `depth/`, and `poses.txt` or `images/`."""
    if not (path / "K.txt").is_file() or not (path / "depth").is_dir():
        return False
    return (path / "poses.txt").is_file() or (path / "images").is_dir()


def recognises_redwood(path: Path) -> bool:
    """True for a folder with depth images and a trajectory, and for a `.log` file of such a folder."""
    if path.is_file():
        return path.suffix == ".log" and _root_of(path) is not None
    return bool(_depth_folders(path)) and _log(path) is not None


def recognises_plain(path: Path) -> bool:
    """True for a folder with one of depth images and one of colour images, or with both in one."""
    if _depth_folders(path):
        return _color_folder(path) is not None
    return bool(_beside(path))


class HoloLens(DepthImages):
    """HoloLens RGB-D as in deep-video-mvs: line k of `poses.txt` belongs to the k-th image by name.

    https://github.com/ardaduz/deep-video-mvs. Time-of-flight depth in uint16 millimetres, registered to
    colour; no timestamps. Options are those of `DepthImages`.
    """

    layout, expected, sensor = "HoloLens", HOLOLENS_EXPECTED, "tof"

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        return depth_images(root / "depth", HOLOLENS_EXPECTED), None

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        path = root / "poses.txt"
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected 16 numbers a line; {SCAN}")
        poses = read_matrix_rows(path)
        if len(poses) != len(files):
            raise DatasetError(
                f"{path} has {len(poses)} poses for {len(files)} depth images; "
                "expected as many: line k belongs to the k-th image"
            )
        return poses

    def _colors(self, root: Path) -> list[Path]:
        return color_images(self._files, root / "images", HOLOLENS_EXPECTED)


class Redwood(DepthImages):
    """Redwood's data sets and Open3D's reconstructions: a `.log` of poses, depth in uint16 millimetres.

    http://redwood-data.org and Open3D's reconstruction system: `depth/` beside `color/`, `image/` or others,
    or Redwood's own `NAME-depth-clean/`, `NAME-color/`, `NAME-traj.txt`. A pose's number is the one in its
    image's file name; of as many poses as images, with other numbers, the k-th pose is the k-th image's.
    Poses without an image are ignored. Images named by their seconds or nanoseconds have times, others none.

    Args:
        path: the folder, or the `.log` in it to take the poses from.
        trajectory: default `trajectory.log`, `scene/trajectory.log`, `odometry.log` or the one file named
            `*traj*.log` or `*-traj.txt`.
        intrinsics, calibration: default a file of the camera in the folder (`cameras.FILES`); for recordings
            that Redwood and Open3D distribute, known by their names, at 640×480 else 525, 525, 319.5, 239.5.

    Other options are those of `DepthImages`.
    """

    layout, expected, guesses = "Redwood", REDWOOD_EXPECTED, True

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        path = Path(path).expanduser()
        if path.is_file():
            path, trajectory = _root_of(path) or path.parent, trajectory or path.absolute()
        self.root, given = super()._opened(path, trajectory)
        return self.root, given

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        self._beside = {} if _depth_folders(root) else _only_series(root)
        files = [*self._beside] or depth_images(_depth_folder(root), REDWOOD_EXPECTED)
        return in_time(files, _names(files))

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        path = _log(root)
        if path is None:
            given = root / "groundtruth.txt"  # TUM's
            hint = f"{SCAN}, or --trajectory {given} names them" if given.is_file() else SCAN
            raise NoPoses(f"{root} has no trajectory; expected {REDWOOD_EXPECTED}; {hint}")
        return self._poses_of(path, files)

    def _poses_of(self, path: Path, files: list[Path]) -> Poses:
        """Poses of a `.log` by number; of another trajectory by time, or one for each image."""
        if is_log(path):
            return poses_by_number(_names(files), read_log(path), path)
        return super()._poses_of(path, files)

    def _colors(self, root: Path) -> Sequence[Path | None]:
        if self._beside:
            return [self._beside[file] for file in self._files]
        where = _color_folder(root)
        return color_images(self._files, where, REDWOOD_EXPECTED) if where else []

    def _known_camera(self, root: Path) -> dict[str, Any]:
        published = _PRIMESENSE if _is_redwoods_own(root) else None
        return {"places": (root, self._files[0].parent), "published": published}


def _names(files: list[Path]) -> list[str]:
    """Names of images; of those that have their colour beside them the only number in each."""
    numbers = [numbers_in(_DEPTH.sub("", file.stem)) for file in files if _DEPTH.search(file.stem)]
    is_numbered = len(numbers) == len(files) and all(len(one) == 1 for one in numbers)
    return [one[0] for one in numbers] if is_numbered else [file.stem for file in files]


def _only_series(root: Path) -> dict[Path, Path | None]:
    """The depth images of a folder, each with its colour image beside it, in their order.

    Raises:
        DatasetError: several series are there.
    """
    found = _beside(root)
    if len(found) > 1:
        names = " and ".join(next(iter(one)).name for one in found)
        raise DatasetError(f"{root} holds several series of depth images ({names}, …); move the others away")
    return found[0] if found else {}


def _beside(root: Path) -> list[dict[Path, Path | None]]:
    """Series of depth images that have their colour images beside them, told by the names."""
    if not root.is_dir():
        return []
    files = {file.name.lower(): file for file in root.glob("[!.]*") if file.suffix.lower() in _IMAGES}
    named = [file for file in files.values() if file.suffix.lower() in SUFFIXES and _DEPTH.search(file.stem)]
    found = []
    for series in series_of(named):
        pairs = {file: _partner(file, files) for file in series}
        if len(series) - list(pairs.values()).count(None) >= _FEWEST and _is_deep(series[0]):
            found.append(pairs)
    return found


def _partner(depth: Path, files: dict[str, Path]) -> Path | None:
    """The colour image whose name says colour where that of the depth image says depth."""
    stems = (_DEPTH.sub(word, depth.stem).lower() for word in COLOR)
    names = (stem + suffix for stem in stems for suffix in COLOR_SUFFIXES)
    return next((files[name] for name in names if name in files), None)


def _is_deep(file: Path) -> bool:
    """True for a PNG image of one 16-bit channel, by its header, and for other formats, judged when read."""
    if file.suffix.lower() != ".png":
        return True
    try:
        with file.open("rb") as opened:
            return opened.read(26)[24:26] == b"\x10\0"
    except OSError:
        return False


def _root_of(log: Path) -> Path | None:
    """The recording that a trajectory lies in: `scene/trajectory.log` is one folder down."""
    log = log.absolute()
    places = (log.parent, log.parent.parent)
    return next((place for place in places if _depth_folders(place) or _beside(place)), None)


def _depth_folders(root: Path) -> list[Path]:
    if (root / "depth").is_dir():
        return [root / "depth"]
    return sorted(path for path in root.glob("*-depth*") if path.is_dir())


def _depth_folder(root: Path) -> Path:
    found = _depth_folders(root)
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise DatasetError(f"{root} holds {len(found)} depth folders ({names}); name the one to use depth/")
    return found[0] if found else root / "depth"


def _color_folder(root: Path) -> Path | None:
    places = [*(root / name for name in COLOR), *sorted(root.glob("*-color"))]
    return next((place for place in places if place.is_dir()), None)


def _log(root: Path) -> Path | None:
    known = [root / name for name in _LOGS if (root / name).is_file()]
    named = [path for pattern in _LOG_NAMES for path in sorted(root.glob(pattern)) if path.is_file()]
    return next((path for path in [*known, *named] if not path.name.startswith(".")), None)


def _is_redwoods_own(root: Path) -> bool:
    names = "/".join(root.resolve().parts[-2:]).lower()
    return bool(_REDWOODS_NAMES.search(names)) or any(any(root.glob(name)) for name in _REDWOODS_FILES)
