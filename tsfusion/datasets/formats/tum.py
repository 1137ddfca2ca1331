# SPDX-License-Identifier: MIT
"""Read TUM RGB-D recordings, and others in their layout: CoRBS (pre-registered) and ICL-NUIM."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import DepthUnit, PublishedCamera
from tsfusion.datasets.dataset import (
    SCAN,
    FramePoses,
    NoPoses,
    Times,
    partners_in_time,
    require_one_clock,
)
from tsfusion.datasets.formats.image_folders import DepthImages
from tsfusion.datasets.readers import listed_file, read_lines
from tsfusion.datasets.trajectory_files import nanoseconds, read_table
from tsfusion.geometry.inertial_sensors import Accelerometer
from tsfusion.geometry.keyframe import Intrinsics

EXPECTED = (
    "groundtruth.txt or *.gt.freiburg, the images that depth.txt and rgb.txt, or associations.txt, list, and "
    "camera-intrinsics.txt unless it is a recording of TUM, CoRBS or ICL-NUIM"
)
DEPTH_SCALE = 1 / 5000  # metres per unit
# A Kinect's accelerometer is rotated by 180° around the optical axis.
_R_CAMERA_KINECT = np.diag((-1.0, -1.0, 1.0))
ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt")


class ImageList(NamedTuple):
    """Images of a recording in time order."""

    timestamps_ns: list[int]  # nanoseconds of each depth image
    depth: list[Path]  # files of the depth images
    # A file or None for each depth image; empty if the recording has no colour
    color: list[Path | None]


def read_recording(root: Path, *, max_difference_ns: int) -> ImageList:
    """Read `depth.txt`, and `rgb.txt` if it exists; or, without `depth.txt`, pairs from `ASSOCIATIONS`.

    Raises:
        DatasetError: a line is malformed, a list is empty, or most listed images are missing.
    """
    pairs = next((root / name for name in ASSOCIATIONS if (root / name).is_file()), None)
    if pairs is not None and not (root / "depth.txt").exists():
        rows = _read(pairs, "`timestamp depth/… timestamp rgb/…` a line, in either order", 2)
        return ImageList(
            [row[0][0] for row in rows], [row[0][1] for row in rows], [row[1][1] for row in rows]
        )
    depth = [row[0] for row in _read(root / "depth.txt", "`timestamp path` a line", 1)]
    stamps, files = [stamp for stamp, _ in depth], [path for _, path in depth]
    if not (root / "rgb.txt").exists():
        return ImageList(stamps, files, [])
    listed = [row[0] for row in _read(root / "rgb.txt", "`timestamp path` a line", 1)]
    partners = partners_in_time([stamp for stamp, _ in listed], stamps, max_difference_ns)
    return ImageList(stamps, files, [None if index is None else listed[index][1] for index in partners])


def _read(path: Path, content: str, images: int) -> list[tuple[tuple[int, Path], ...]]:
    """Return (timestamp_ns, image) of each line, in time order; in a pair, first the path with "depth"."""
    rows: list[tuple[tuple[int, Path], ...]] = []
    for number, line in read_lines(path, content):
        words = line.split(maxsplit=1) if images == 1 else line.split()
        deep = ["depth" in name.lower() for name in words[1::2]]
        if len(words) != 2 * images or (images == 2 and deep[0] == deep[1]):
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        pairs = zip(words[::2], words[1::2], strict=True)
        row = [(nanoseconds(stamp, path, number), listed_file(path.parent, name)) for stamp, name in pairs]
        rows.append(tuple(row if deep[0] or images == 1 else reversed(row)))
    if not rows:
        raise DatasetError(f"{path} lists no images; expected {content}")
    listed = [file for row in rows for _, file in row]
    missing = [file for file in listed if not file.is_file()]
    if 2 * len(missing) > len(listed):
        raise DatasetError(
            f"{missing[0]} is missing ({len(missing)} of {len(listed)} images that {path} lists)"
        )
    require_one_clock([row[0][0] for row in rows], path)
    return sorted(set(rows))  # without repeated lines


class _Benchmark(NamedTuple):
    """Benchmark in this layout. Its recordings are known by the folder's name."""

    name: str
    folder: str  # regular expression for the last two folder names
    intrinsics: Intrinsics
    source: str
    sensor: str = "kinect"
    distortion: tuple[float, ...] = ()  # of the colour camera, onto whose pixels depth is registered


_ICL = _Benchmark(
    "ICL-NUIM",
    r"icl[-_]?nuim|(living|office)_room_traj|traj\d\w?_(frei|loop)",
    Intrinsics(481.2, -480.0, 319.5, 239.5),
    "ICL-NUIM",
)
_BENCHMARKS = (
    _Benchmark(
        "CoRBS", r"corbs|\w\d_pre[-_]?registered", Intrinsics(468.60, 468.61, 318.27, 243.99), "CoRBS", "tof"
    ),
    _ICL,
    _Benchmark("TUM", r"freiburg1", Intrinsics(517.3, 516.5, 318.6, 255.3), "TUM freiburg1",
               distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    _Benchmark("TUM", r"freiburg2", Intrinsics(520.9, 521.0, 325.1, 249.7), "TUM freiburg2",
               distortion=(0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    _Benchmark("TUM", r"freiburg3", Intrinsics(535.4, 539.2, 320.1, 247.6), "TUM freiburg3"),
)  # fmt: skip


class TUM(DepthImages):
    """Lists of time-stamped images and a trajectory, associated by time.

    It reads the lists (`timestamp path`) of https://cvg.cit.tum.de/data/datasets/rgbd-dataset, those of CoRBS
    (http://corbs.dfki.uni-kl.de: backslashes, CRLF), and ICL-NUIM as published
    (https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html: `associations.txt`, `*.gt.freiburg`). Each depth
    image gets the nearest colour image, and a pose interpolated at its time. Depth images without a colour
    image are kept and counted in `uncolored`.

    Args:
        path: folder with `depth.txt` or `associations.txt`.
        trajectory: default `groundtruth.txt` in the folder, or in a sibling `*_Trajectory` folder (CoRBS); or
            `*.gt.freiburg` in the folder, or beside it under ICL-NUIM's own name.
        intrinsics, calibration: default a camera file in the folder (`cameras.FILES`); else the benchmark's
            camera and lens, by the folder's name (freiburg1-3, CoRBS, ICL-NUIM), only at 640×480.
        depth_scale: metres per unit; default as stated by a camera file, else 1/5000, and 1 for floats.
        max_difference_s: between a depth image and its colour image, seconds.
        options: those of `DepthImages`.
    """

    layout, expected, usual_gap_s = "TUM", EXPECTED, 0.1
    signs = (("depth.txt", *ASSOCIATIONS),)
    usual_unit = DepthUnit(DEPTH_SCALE, "usual for TUM RGB-D", is_stated=False)
    quaternions = True

    def __init__(self, path: str | Path, *, max_difference_s: float = 0.02, **options: Any) -> None:
        self._max_difference_ns = round(max_difference_s * 1e9)
        super().__init__(path, **options)

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        self._listed = read_recording(root, max_difference_ns=self._max_difference_ns)
        self._benchmark = _benchmark(root)
        if self._benchmark is not None:
            self.layout, self.sensor = self._benchmark.name, self._benchmark.sensor
            self.usual_unit = DepthUnit(DEPTH_SCALE, f"published for {self._benchmark.source}")
        self._accelerometer = read_table(
            Accelerometer(_R_CAMERA_KINECT), root / "accelerometer.txt", "`timestamp ax ay az` a line",
            separator=None, first=1,
        )  # fmt: skip
        return self._listed.depth, np.array(self._listed.timestamps_ns, np.int64)

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        return self._poses_of(_trajectory(root), files)

    def _colors(self, root: Path) -> list[Path | None]:
        return [self._listed.color[index] for index in self._kept] if self._listed.color else []

    def _known_camera(self, root: Path) -> dict[str, Any]:
        own = self._benchmark
        known = own and PublishedCamera(own.source, own.intrinsics, distortion=own.distortion)
        return {"places": (root, self._files[0].parent), "published": known}


def _trajectory(root: Path) -> Path:
    found = [path for path in (root / "groundtruth.txt", *_corbs(root), *_icl(root)) if path.is_file()]
    if not found:
        raise NoPoses(
            f"{root / 'groundtruth.txt'} is missing; expected `timestamp tx ty tz qx qy qz qw` a line "
            f"(one elsewhere: --trajectory FILE, in Python trajectory=FILE); {SCAN}"
        )
    return found[0]


def _corbs(root: Path) -> list[Path]:
    """Return possible trajectories of CoRBS: D1_pre_registereddata belongs to D1_Trajectory beside it.

    If an archive was unpacked to a folder of its own, the trajectory is one level further up.
    """
    own = root.name.split("_")[0]
    places = [place for up in root.absolute().parents[:2] for place in sorted(up.glob("*_Trajectory*"))]
    return [
        file
        for place in places
        if place.name.split("_")[0] == own
        for file in (place / "groundtruth.txt", place / place.name / "groundtruth.txt")
    ]


def _icl(root: Path) -> list[Path]:
    """Return trajectories of ICL-NUIM: `*.gt.freiburg` in the folder, or beside it under the scene's name."""
    number = re.search(r"traj(\d)", root.name)
    if number is None:
        return sorted(root.glob("[!.]*.gt.freiburg"))
    room = "livingRoom" if "living" in root.name else "traj"
    return [*sorted(root.glob("[!.]*.gt.freiburg")), root.parent / f"{room}{number[1]}.gt.freiburg"]


def _benchmark(root: Path) -> _Benchmark | None:
    names = "/".join(root.resolve().parts[-2:]).lower()
    for benchmark in _BENCHMARKS:
        if re.search(benchmark.folder, names):
            return benchmark
    return _ICL if any(root.glob("*.gt.freiburg")) else None
