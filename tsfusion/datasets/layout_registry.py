# SPDX-License-Identifier: MIT
"""List the known layouts of recordings, and find the layout of a path.

Another package adds a `Layout` by an entry point in the group `tsfusion.datasets`. Such layouts are tried
before the built-in ones.
"""

import logging
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsfusion.core import plugins
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import camera_line, depth_line
from tsfusion.datasets.dataset import Dataset, Frames, first_frame, pose_of
from tsfusion.datasets.download import archives
from tsfusion.datasets.folder_frames import FolderFrames, WithTrajectory
from tsfusion.datasets.formats import azure_kinect, kitti, packets
from tsfusion.datasets.formats.euroc import EuRoC
from tsfusion.datasets.formats.folder_table import (
    PLAIN_EXPECTED,
    HoloLens,
    Redwood,
    Replica,
    ScanNet,
    SevenScenes,
)
from tsfusion.datasets.formats.image_folders import StereoFolder
from tsfusion.datasets.formats.nerfstudio import Nerfstudio
from tsfusion.datasets.formats.phones import ARKitScenes, Polycam, Record3D, ScannerApp, StrayScanner
from tsfusion.datasets.formats.scan_folders import LidarDump, ScanFolder, ScanPair, clouds_in, is_cloud
from tsfusion.datasets.formats.tum import TUM
from tsfusion.datasets.rosbag import bag as rosbag_dataset
from tsfusion.datasets.rosbag.reader import ENDINGS
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.origin import System

GROUP = "tsfusion.datasets"

_log = logging.getLogger(__name__)
LONE = (".r3d", ".mkv", ".pcap", ".pcapng", ".osf")  # a file with such a suffix is a recording
_DEEPEST, _MOST_PLACES = 3, 100  # further folders down, and so many of each, that are searched
_MOST_NAMED = 8
_ZED = (
    "a ZED's recording, read by the ZED SDK alone; export its pairs to left/ and right/, with a calibration"
)
_FOREIGN = {  # files that other programs convert first
    ".sens": "a ScanNet recording; export it to folders first with ScanNet's SensReader",
    ".svo": _ZED,
    ".svo2": _ZED,
    ".oni": "an OpenNI recording; export it to depth/ and color/ first, such as with OpenNI2's tools",
    ".e57": "a cloud in E57; write it as LAS, PLY or PCD first (CloudCompare, `pdal translate`)",
}
_MAC = "__MACOSX"  # folder that macOS adds to archives
_INDEX = (".txt", ".json", ".yaml", ".csv", ".freiburg")  # a file with such a suffix stands for its folder


class Layout(NamedTuple):
    """One way to store recordings on disk.

    Attributes:
        name: for reports.
        description: the expected files, in one line.
        recognises: function that returns True for a folder or file in this layout. It is quick, reads no
            images and raises nothing. The layout of a world returns True for `Path("synthetic:WORLD")`.
        open: `open(path, **options)` → a dataset. It takes `posed` if frames may lack a pose. The layout of a
            world takes `world` and `sensor` by name.

    Examples:
        >>> from tsfusion.datasets import layouts
        >>> "7-Scenes" in [layout.name for layout in layouts()]
        True
    """

    name: str
    description: str
    recognises: Callable[[Path], bool]
    open: Callable[..., Dataset]


class FoundDataset(NamedTuple):
    """A dataset at a path, with its layout."""

    path: Path  # the folder or file to open: the given one, or the only dataset in it
    layout: Layout
    also: tuple[str, ...]  # names of less specific layouts that fit too

    def open(self, /, **options: Any) -> Dataset:
        """Open the dataset. Options that are None are left out.

        Raises:
            DatasetError: the files are wrong, or the layout does not have an option.
        """
        return open_as(self.layout.name, partial(self.layout.open, self.path), options)


def _row(layout: type[FolderFrames], name: str = "", also: str = "") -> Layout:
    return Layout(name or layout.layout, layout.expected + also, layout.recognises, layout)


# In the order of trial: specific layouts first.
BUILT_IN = (
    _row(EuRoC),
    Layout("KITTI odometry", kitti.EXPECTED, kitti.recognises, kitti.KITTI),
    Layout("KITTI raw", kitti.RAW_EXPECTED, kitti.recognises_raw, kitti.KITTIRaw),
    _row(SevenScenes),
    _row(ScanNet),
    _row(Replica),
    _row(Nerfstudio),
    *map(_row, (Record3D, StrayScanner, Polycam, ScannerApp, ARKitScenes)),
    _row(LidarDump),
    _row(TUM, "TUM RGB-D", " (also CoRBS, ICL-NUIM)"),
    _row(HoloLens),
    _row(Redwood),
    Layout("Azure Kinect", azure_kinect.EXPECTED, azure_kinect.recognises, azure_kinect.AzureKinect),
    Layout("LiDAR packets", packets.EXPECTED, packets.recognises, packets.LidarPackets),
    Layout("ROS bag", rosbag_dataset.EXPECTED, rosbag_dataset.recognises, rosbag_dataset.Bag),
)
# Tried if no other layout fits.
PLAIN = (Layout("RGB-D folders", PLAIN_EXPECTED, Redwood.recognises_plain, Redwood), _row(StereoFolder))
# Tried if nothing fits another layout: points beside a recording are often made from the recording.
SCANS = (_row(ScanPair), _row(ScanFolder))
SYNTHETIC = (
    "synthetic",
    "no files: synthetic:WORLD, or synthetic:WORLD:SENSOR; worlds: room (also -untextured, -plain, -bare), "
    "street, corridor, rooms; sensors: kinect, tof, stereo, lidar",
)


def layouts() -> list[Layout]:
    """Return every layout, in the order in which they are tried."""
    return [*_plugins(), *BUILT_IN, *PLAIN, *SCANS]


def world_layout(name: str) -> Layout | None:
    """Return another package's layout for `synthetic:NAME`, or None."""
    return next((one for one in _plugins() if _recognises(one, Path(f"synthetic:{name}"))), None)


def find(path: str | Path, *, unpack: bool = False) -> FoundDataset:
    """Find the dataset at a path: its folder, a folder with only this one, or a file that stands for it.

    Args:
        unpack: True unpacks an archive beside itself. Otherwise the error names the command that does.

    Raises:
        DatasetError: there is no dataset, or more than one. The message says what was expected.
    """
    root = Path(path).expanduser()
    if not root.exists():
        raise DatasetError(f"{root} does not exist; expected a dataset or synthetic:room, synthetic:street")
    if root.name in ("", ".."):  # such as the current folder: benchmarks are recognised by the folder's name
        root = root.resolve()
    if root.is_file() and archives.is_archive(root):
        root = _unpacked(root, unpack=unpack)
    found = _match([root])
    if not found and root.is_file():
        found = _match([root.absolute().parent]) if root.suffix.lower() in _INDEX else _match([root], SCANS)
    elif not found:
        found = _below(root)
    if len(found) != 1:
        raise DatasetError(_unrecognised(root, [place.path for place in found]))
    if found[0].also:
        _log.warning(
            "%s is read as %s; it fits %s too",
            found[0].path, found[0].layout.name, ", ".join(found[0].also),
        )  # fmt: skip
    return found[0]


def open_as(name: str, opener: Callable[..., Dataset], options: dict[str, Any]) -> Dataset:
    """Call a layout's opener, which can lack the options `posed` and `trajectory`.

    Without `posed` in the opener, the option has no effect. Without `trajectory`, the poses are added here.
    `poses` is another name of `trajectory`. All layouts have the options `origin` and `crs` (see
    `Frames.take_off_origin`) and `depth_along_ray`: depth images hold distances along rays, which become z.

    Raises:
        DatasetError: an option is unknown to the opener, or has the wrong type.
    """
    options = dict(options)
    origin, crs, along_ray = (options.pop(each, None) for each in ("origin", "crs", "depth_along_ray"))
    dataset = _open_as(name, opener, options)
    if along_ray is not None:
        if not isinstance(along_ray, bool) or not isinstance(dataset, Frames):
            raise DatasetError(
                f"depth_along_ray must be true or false, for depth image files; got {along_ray!r} for {name}"
            )
        dataset.along_ray = along_ray
    if isinstance(dataset, Frames):
        dataset.take_off_origin(origin, crs)
    elif origin is not None or crs is not None:
        raise DatasetError(f"a {name} dataset has poses of its own: leave out the options origin and crs")
    return dataset


def _open_as(name: str, opener: Callable[..., Dataset], options: dict[str, Any]) -> Dataset:
    if not plugins.takes(opener, "posed"):
        options.pop("posed", None)
    for camera in ("intrinsics", "calibration"):
        if options.get(camera) is not None and not plugins.takes(opener, camera):
            raise DatasetError(f"a {name} dataset has a camera of its own: leave out --{camera}")
    for given, known in (("poses", "trajectory"), ("trajectory", "poses")):
        if given in options and not plugins.takes(opener, given) and plugins.takes(opener, known):
            options[known] = options.pop(given)
    trajectory = options.get("trajectory")
    if trajectory is None or plugins.takes(opener, "trajectory"):
        return plugins.call(opener, options, name=f"a {name} dataset", error=DatasetError)
    del options["trajectory"]
    posed = options.get("posed", True)
    if plugins.takes(opener, "posed"):
        options["posed"] = False
    where = {key: options[key] for key in ("max_gap_s", "time_offset_s") if options.get(key) is not None}
    options = {key: value for key, value in options.items() if key not in where or plugins.takes(opener, key)}
    dataset = plugins.call(opener, options, name=f"a {name} dataset", error=DatasetError)
    return WithTrajectory(dataset, Path(trajectory).expanduser(), posed=posed, **where)


def describe(dataset: Dataset) -> str:
    """Return one line: number and kind of frames, size, rate, poses, camera.

    Reads one frame, and some two dozen where colour may be another camera's.
    """
    first = first_frame(dataset)
    words = {"pair": "stereo pairs", "points": "scans", "disparity": "disparity images"}
    kind = words.get(first.kind) or ("depth images" if first.color is None else "RGB-D frames")
    size = "" if first.kind == "points" else f" {first.shape[1]}×{first.shape[0]}"
    stamps = dataset.timestamps_ns
    rate = ""
    if stamps is not None and len(stamps) > 1 and stamps[-1] > stamps[0]:
        rate = f" at {(len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9:.3g} Hz"
    posed = sum(pose_of(dataset, index) is not None for index in range(len(dataset)))
    poses = "no poses" if not posed else "all with poses" if posed == len(dataset) else f"poses for {posed}"
    uncolored = getattr(dataset, "uncolored", 0)
    color = f", {uncolored} without colour in time" if uncolored else ""
    unit = depth_line(dataset, first)
    camera = camera_line(dataset, first)
    seen = f"; {unit}" * bool(unit) + f"; camera {camera}" * bool(camera)
    system = getattr(dataset, "system", System())
    if getattr(dataset, "in_world", False):
        seen += "; points in the frame of the poses" + ", taken for metres" * (system == System())
    if system.metres != System().metres:
        seen += f"; units of {system.metres[0]:.9g} m become metres"
    if origin := getattr(dataset, "origin", None):
        seen += f"; positions count from the origin {origin}"
    if doubt := sweep_doubt(first):
        seen += f"; {doubt}"
    elif first.point_times_s is not None:
        seconds = np.ptp(first.point_times_s)
        seen += f"; motion is taken out of sweeps of {seconds:.2g} s (--option deskew=false leaves it)"
    return f"{dataset.name}, {len(dataset)} {kind}{size}{rate}, {poses}{color}{seen}"


def sweep_doubt(first: Frame) -> str:
    """Return why motion within a LiDAR's sweeps is unknown; empty if it is known, or points have no times."""
    if first.untimed:
        return first.untimed
    lacks = first.motion is None and first.T_world_camera is not None and first.point_times_s is not None
    return "its poses tell no motion within sweeps" if lacks else ""


def _unpacked(path: Path, *, unpack: bool) -> Path:
    into = archives.destination(path)
    if into.is_dir():
        return into
    if unpack:
        return archives.unpack(path)
    raise DatasetError(
        f"{path} is an archive; unpack it with: {archives.command(path)}, then open {into} "
        "(or let --unpack do so; in Python unpack=True)"
    )


def _match(places: Iterable[Path], only: tuple[Layout, ...] = ()) -> list[FoundDataset]:
    """Return the datasets at these paths: of the layouts in `only`, or of all, the least specific last."""
    ranked = [] if only else [*_plugins(), *BUILT_IN]
    found = []
    for place in places:
        fitting = [layout for layout in ranked if _recognises(layout, place)]
        fitting = fitting or [layout for layout in only or PLAIN if layout.recognises(place)]
        if fitting:
            found.append(FoundDataset(place, fitting[0], tuple(layout.name for layout in fitting[1:])))
    return found


def _recognises(layout: Layout, place: Path) -> bool:
    if layout in BUILT_IN:
        return layout.recognises(place)
    try:
        return layout.recognises(place)
    except Exception as error:  # noqa: BLE001 - another package's code
        _log.warning("the layout %s failed on %s: %r", layout.name, place, error)
        return False


def _plugins() -> list[Layout]:
    found = []
    for point in entry_points(group=GROUP):
        try:
            found.append(Layout(*plugins.load(point, DatasetError)))
        except (DatasetError, TypeError) as error:
            _log.warning("the dataset layout %s is left out: %s", point.name, error)
    return found


def _folders_in(root: Path, *, strict: bool = True) -> list[Path]:
    try:
        return sorted(
            child
            for child in root.iterdir()
            if child.is_dir() and not child.name.startswith(".") and child.name != _MAC
        )
    except OSError as error:
        if not strict:
            return []
        raise DatasetError(f"cannot read {root}: {error.strerror}") from error


def _below(root: Path) -> list[FoundDataset]:
    """Return the datasets in the nearest folders that hold any; scans count in the folder itself, too."""
    places = _folders_in(root)
    seen = [root, *places]
    found = _match(places) or _match([root], SCANS) or _match(places, SCANS)
    for _ in range(0 if found else _DEEPEST):
        places = [inner for place in places for inner in _folders_in(place, strict=False)][:_MOST_PLACES]
        seen += places
        found = found or _match(places) or _match(places, SCANS)
    found = found or _match((cloud for place in seen for cloud in clouds_in(place)), SCANS)
    files = (file for place in seen for file in sorted(place.glob("[!.]*")))
    return found or _match(file for file in files if file.suffix.lower() in LONE)


def _unrecognised(root: Path, several: list[Path]) -> str:
    if several and all(map(is_cloud, several)):
        names = ", ".join(path.name for path in several[:_MOST_NAMED]) + ", …" * (len(several) > _MOST_NAMED)
        return (
            f"{root} holds {len(several)} clouds of points ({names}); open one, or name those of one LiDAR "
            "by numbers or times, with its poses in poses.txt (two scans A and B: T_A_B.txt)"
        )
    if several:
        return f"{root} holds {len(several)} datasets; open one of them: {', '.join(map(str, several))}"
    if cure := _FOREIGN.get(root.suffix.lower()):
        return f"{root} is {cure}"
    if root.is_file() and root.suffix.lower() in ENDINGS:
        realsense = f"; a RealSense recording: `tsfusion scan realsense:{root}`" * (root.suffix == ".db3")
        return (
            f"{root} is no ROS bag, by its first bytes; expected a whole {', '.join(ENDINGS)} file{realsense}"
        )
    if root.is_file():
        return (
            f"{root} is not a folder, nor a file that stands for a dataset (an archive, a transforms.json, "
            "a trajectory.log, a file of a recognised folder)"
        )
    known = ", ".join(layout.name for layout in layouts())
    return f"{root} is in no layout known here: {known}; `tsfusion datasets` says what each expects"
