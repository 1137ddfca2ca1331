# SPDX-License-Identifier: MIT
"""Yield the frames that another program writes to a folder."""

import logging
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, InvalidKeyframe, SourceError, refusals_as
from tsfusion.datasets import file_names, readers, scan_files, stereo_pairs
from tsfusion.datasets.cameras import FILES, UnknownCamera, camera_files, find_camera
from tsfusion.datasets.color_placement import SPREAD, color_placement
from tsfusion.datasets.dataset import UNREADABLE
from tsfusion.datasets.formats.folder_table import NOT_MEASURED, Replica, SevenScenes
from tsfusion.datasets.formats.image_folders import COLOR, SUFFIXES, DepthImages, DepthReader, ImagesAt
from tsfusion.datasets.readers import read_depth, read_image
from tsfusion.datasets.scan_files import PointTimes, point_times, read_scan
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.source import LiveSource, monotonic_of

log = logging.getLogger(__name__)

END_MARKERS = ("DONE", ".end")  # a file of this name ends the source
SENSORS = {"depth": "kinect", "pair": "stereo", "points": "lidar"}

_PAUSE_FACTOR = 10  # the pause between two listings is at least 10 times as long as a listing
_AT_REST_S = 0.5  # seconds without a change after which a file without an end mark counts as complete
_OLDEST_S = 600.0  # a file time that seems older is of another clock
_FIRST_TRIES = 5  # so many unreadable frames, with no readable one before, end the source
_ENOUGH = 10  # names needed to check the fractions in them
_WAIT = object()  # the frame's files are not complete yet
_UNREADABLE = DatasetError, InvalidKeyframe, InvalidConfig, cv2.error, OSError


_PNG_END, _JPEG_END = b"\0\0\0\0IEND\xaeB`\x82", b"\xff\xd9"
_ENDS = {".png": _PNG_END, ".jpg": _JPEG_END, ".jpeg": _JPEG_END}
_POINT = 16  # bytes: x, y, z and intensity in float32


class FolderLayout(NamedTuple):
    """Names of a frame's files: the first file, and for images a second file with the same part in its name.

    `files` describes both files; {} stands for the folder of the second. `of` gives the usual depth unit.
    """

    kind: Literal["depth", "pair", "points"]
    files: str
    first: ImagesAt
    second: ImagesAt | None = None
    suffixes: tuple[str, ...] = readers.DEPTH_SUFFIXES  # of the first file
    of: type[DepthImages] = DepthImages

    def is_in(self, root: Path) -> bool:
        """Return True if a folder has this layout: the layout's own subfolders, or else a first file."""
        needed = [self.first, *([self.second] if self.second and self.kind == "pair" else ())]
        if not all(at.folder(root).is_dir() for at in needed):
            return False
        if self.first.places != ("",) and self.first.name == "{}":
            return True
        where, pattern = self.first_files(root)
        return any(pattern.fullmatch(name) for name in os.listdir(where))

    def first_files(self, root: Path) -> tuple[Path, re.Pattern[str]]:
        """Return the folder of the first files, and a name pattern whose group is the shared part."""
        start, end = map(re.escape, self.first.name.split("{}"))
        suffixes = "|".join(map(re.escape, self.suffixes))
        return self.first.folder(root), re.compile(rf"{start}([^.].*){end}(?:{suffixes})")

    def partner(self, root: Path, shared: str) -> Path | None:
        """Return the second file of a frame, or None if it does not exist."""
        if self.second is None:
            return None
        stem = self.second.folder(root) / self.second.name.format(shared)
        return next((path for suffix in SUFFIXES if (path := Path(f"{stem}{suffix}")).exists()), None)

    def words(self, root: Path) -> str:
        """Return text that describes the files of a frame."""
        return self.files.format("" if self.second is None else self.second.folder(root).name)


LAYOUTS = (
    FolderLayout("depth", "depth/NAME.png|tiff|exr|npy with {}/NAME.png|jpg",
                 DepthImages.depth_at, ImagesAt(COLOR)),
    FolderLayout("pair", "left/ and right/NAME.png|jpg",
                 ImagesAt(("left",)), ImagesAt(("right",)), SUFFIXES),
    FolderLayout("points", "velodyne/NAME.bin|pcd|ply|las|laz",
                 ImagesAt(("velodyne",)), None, scan_files.SUFFIXES),
    FolderLayout("depth", "frame-*.depth.png with frame-*.color.png|jpg",
                 SevenScenes.depth_at, SevenScenes.color_at, (".png",), SevenScenes),
    FolderLayout("depth", "results/depth*.png with results/frame*.jpg",
                 Replica.depth_at, Replica.color_at, (".png",), Replica),
    *(FolderLayout("points", f"NAME{suffix}", ImagesAt(("",)), None, (suffix,))
      for suffix in scan_files.SUFFIXES),  # a file of another format may be no scan, such as a mesh
)  # fmt: skip
EXPECTED = (
    "depth/NAME.png|tiff|exr|npy with color/, colour/, rgb/, image/ or images/NAME.png|jpg; "
    "frame-*.depth.png with frame-*.color.png|jpg; results/depth*.png with results/frame*.jpg; left/ and "
    "right/NAME.png|jpg; NAME.bin|pcd|ply|las|laz, there or in velodyne/"
)


class WatchedFolder(LiveSource):
    """Frames of a folder in the order of their names. Each is yielded as soon as its files are complete.

    `LAYOUTS` lists the layouts. Existing files come first. An incomplete frame delays the frames after it,
    and is left out after `deadline` seconds without a change. Colour that another camera took is registered
    once enough frames show where it lies (`color_placement`): the first frame waits for them, unless for
    `deadline` or `idle` seconds no frame is added. Timestamps come from the names (decimal seconds, or
    nanoseconds), otherwise from the times of the files. The source ends with a file `DONE` or `.end`, or
    after `idle` seconds without a new frame. It remembers the name of every frame (100 bytes each).

    Args:
        path: an existing folder; its layout and its camera may be written later.
        intrinsics: by default from a camera file in the folder or its parent (`cameras.FILES`).
        calibration: a camera file, instead of intrinsics. For left/ and right/ the file of a stereo camera,
            as for `stereo_pairs.read_rectifier`; by default from the folder. Without one, the images must be
            rectified, with intrinsics and `baseline.txt`.
        baseline: metres, for rectified images in left/ and right/.
        depth_scale: metres per unit; by default from a camera file, else 0.001, and 1 for floats.
        depth_along_ray: True if depth images hold distances along each pixel's ray, instead of z.
        deskew: False for points that are already corrected for the motion, though they have times.
        idle: seconds; None = wait for ever.
        deadline: seconds to wait for an incomplete frame or a missing camera.
        poll: smallest number of seconds between two listings of the folder.

    Raises:
        SourceError: the folder or the calibration does not exist.
    """

    live = False  # files stay until they are read

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        baseline: float | None = None,
        depth_scale: float | None = None,
        depth_along_ray: bool = False,
        deskew: bool = True,
        idle: float | None = None,
        deadline: float = 5.0,
        poll: float = 0.05,
        sensor: str | None = None,
    ) -> None:
        root = Path(path).expanduser()
        if not root.is_dir():
            raise SourceError(f"{root} is not a folder; expected one that frames are written to")
        if calibration is not None and not Path(calibration).expanduser().exists():
            raise SourceError(f"calibration: {calibration} does not exist")
        self._root, self._layout = root, _layout_of(root)
        self._places = (root, root.absolute().parent)  # folders that may hold a camera file
        super().__init__(f"folder {root.name}", "kinect")
        self._sensor = sensor
        self._name_sensor()
        self._intrinsics, self._calibration, self._baseline = intrinsics, calibration, baseline
        self._deskew, self._untimed = deskew, ""
        self._depth_scale, self._along_ray = depth_scale, depth_along_ray
        self._idle, self._deadline, self._poll = idle, deadline, poll
        self._opened_ns, self._stamp = time.time_ns(), 0
        self._handled: set[str] = set()  # names of first files
        self._last: file_names.SortKey = ()  # of the newest frame that was read
        self._colored: bool | None = None  # True if frames come with colour; None = not known yet
        self._camera: Any = None  # a RecordedCamera or a PairRectifier
        self._depth = DepthReader()
        self._depth.not_measured = NOT_MEASURED
        self._times_checked = False
        self._why_unreadable = ""
        self._begun: Any = None  # state of the incomplete frame's files
        self._since = time.monotonic()  # when something last changed
        self._waiting = 0, 0.0  # largest number of frames that waited, and since when

    def waits_for(self) -> str:
        """Return text for the user: the folder's contents, the next frame's needs, when the source ends."""
        there = len(self._list())
        if self._layout is None:
            wanted = f"no frames yet; waits for {EXPECTED}"
        elif there:
            wanted = f"{there} frames are there; waits for more: {self._layout.words(self._root)}"
        else:
            wanted = f"no frames yet; waits for {self._layout.words(self._root)}"
        if self._needs_camera():
            wanted += f", and for a camera: {FILES}, or --intrinsics or --calibration"
        ends = f"when a file {' or '.join(END_MARKERS)} appears there, or with Ctrl-C"
        if self._idle is not None:
            ends = f"after {self._idle:g} s without a new frame, {ends}"
        return f"{self._root}: {wanted}; ends {ends}"

    def _needs_camera(self) -> bool:
        """Return True if no camera was given and the folder holds none yet."""
        if self._intrinsics is not None or self._calibration is not None:
            return False
        if self._layout is not None and self._layout.kind == "points":
            return False
        try:
            return not any(camera_files(place) for place in self._places)
        except DatasetError:  # it may be half written
            return False

    def __iter__(self) -> Iterator[Frame]:
        self._since = time.monotonic()
        while not self._closed.is_set():
            ended = any((self._root / name).exists() for name in END_MARKERS)
            looked = time.monotonic()
            waiting = self._list()
            pause = max(self._poll, _PAUSE_FACTOR * (time.monotonic() - looked))
            for name, first in waiting:
                if self._closed.is_set():
                    return
                frame = self._read(name, first, final=ended)
                if frame is _WAIT:
                    break
                self._handled.add(first.name)
                if isinstance(frame, Frame):
                    self._last = file_names.order(name)
                    yield frame
                self._since = time.monotonic()
            else:
                if ended or (self._idle is not None and time.monotonic() - self._since > self._idle):
                    if self._why_unreadable and not self._last:
                        raise SourceError(self._why_unreadable)
                    return
            self._closed.wait(pause)

    def _list(self) -> list[tuple[str, Path]]:
        """Return (name, first file) of new frames, in order."""
        with refusals_as(SourceError, f"{self._root} cannot be read any more"):
            if self._layout is None or not self._handled:  # the folder of colour may still come
                self._layout = _layout_of(self._root)
                self._name_sensor()
            if self._layout is None:
                return []
            where, pattern = self._layout.first_files(self._root)
            with os.scandir(where) as entries:
                files = [entry.name for entry in entries if entry.name not in self._handled]
        found = []
        for file in files:
            match = pattern.fullmatch(file)
            if match and file_names.order(match[1]) < self._last:
                self._handled.add(file)
                self._skip("late")
            elif match:
                found.append((match[1], where / file))
        if not self._times_checked and len(found) + len(self._handled) >= _ENOUGH:
            self._times_checked = True
            self._check_times([*(Path(file).stem for file in self._handled), *(name for name, _ in found)])
        if len(found) > self._waiting[0]:
            self._waiting = len(found), time.monotonic()
        return sorted(found, key=lambda item: file_names.order(item[0]))

    def _check_times(self, names: list[str]) -> None:
        """Raise SourceError if the times in names, read together, differ from those read one by one."""
        alone = sorted(stamp for name in names if (stamp := file_names.time_of(name)) is not None)
        try:
            series = file_names.in_time([Path(name) for name in names], names)[1]
        except DatasetError as error:
            raise SourceError(str(error)) from error
        if series is not None and len(alone) == len(names) and alone != series.tolist():
            raise SourceError(
                f"{self._root}: fractions in names such as {names[0]} are no decimals, as other names show: "
                "write SEC.NNNNNNNNN with leading zeros, or `tsfusion scan PATH` when the folder is complete"
            )

    def _read(self, name: str, first: Path, *, final: bool) -> Any:
        """Return a frame; None if it is left out; `_WAIT` if its files may still grow, unless `final`."""
        assert self._layout is not None
        kind, second = self._layout.kind, self._layout.partner(self._root, name)
        state = (name, *(_state(path) for path in (first, second)))
        if state != self._begun:
            self._begun, self._since = state, time.monotonic()
        waited = time.monotonic() - self._since
        ended, final = final, final or waited > self._deadline
        is_pair = kind == "pair"
        if second is None and (is_pair or (self._layout.second is not None and self._colored is not False)):
            if not final:
                return _WAIT
            if is_pair or self._colored:
                return self._skip("without its other image")
            self._colored = False  # no frame has colour
        files = [first] if second is None else [first, second]
        try:
            is_at_rest = final or max(waited, time.time() - first.stat().st_mtime) > _AT_REST_S
            if not all(is_whole(file, is_at_rest=is_at_rest) for file in files):
                return self._unreadable(first, f"{first} is not complete") if final else _WAIT
            if kind != "points" and self._camera is None and not self._find_camera(kind, first, final=final):
                return _WAIT
            self._colored = self._colored or (kind == "depth" and len(files) == 2)
            count = len(self._handled)
            if self._colored and not count and not ended and self._may_tell_place():
                return _WAIT
            if self._colored and self._depth.place is None and not count & (count - 1):  # 0, 1, 2, 4, 8, …
                self._place_color()
            frame = self._frame(kind, files, *self._stamps(name, first))
        except _UNREADABLE as error:
            return self._unreadable(first, error)
        return frame

    def _may_tell_place(self) -> bool:
        """Return True while so few frames are there that the next may tell the place of colour."""
        most_s = self._deadline if self._idle is None else min(self._deadline, self._idle)
        return self._waiting[0] < SPREAD and time.monotonic() - self._waiting[1] < most_s

    def _unreadable(self, first: Path, error: object) -> None:
        """Leave out a frame. For the first such frame, log the reason.

        Raises:
            SourceError: the first `_FIRST_TRIES` frames are all unreadable.
        """
        if not self._why_unreadable:
            self._why_unreadable = str(error)
            log.warning("%s: %s is left out: %s", self.name, first.name, error)
        self._skip(UNREADABLE)
        if not self._last and self.skipped[UNREADABLE] >= _FIRST_TRIES:
            raise SourceError(self._why_unreadable)

    def _frame(self, kind: str, files: list[Path], timestamp_ns: int, captured_ns: int) -> Frame:
        measured: dict[str, Any]
        if kind == "pair":
            left, right = map(_image, files)
            measured = stereo_pairs.pair_of(left, right, self._camera)
        elif kind == "points":
            scan = read_scan(files[0])
            found = point_times(scan, timestamp_ns) if self._deskew else PointTimes()
            if found.untimed and found.untimed != self._untimed:
                log.warning("%s: %s", self.name, found.untimed)
                self._untimed = found.untimed
            measured = {"points": scan.points, **found._asdict()}
        else:
            measured = self._depth.read(files[0], files[1] if files[1:] else None)
        frame = Frame(sensor=self.sensor, timestamp_ns=timestamp_ns, captured_ns=captured_ns, **measured)
        frame = frame.along_axis() if self._along_ray and kind == "depth" else frame
        return frame if self._depth.place is None else self._depth.place.registered(frame)

    def _place_color(self) -> None:
        """Look in all whole frames so far for the camera of their colour, as a scan of all frames does."""
        assert self._layout is not None
        where, pattern = self._layout.first_files(self._root)
        names = {match[1]: where / match[0] for match in map(pattern.fullmatch, os.listdir(where)) if match}
        ordered = sorted(names.items(), key=lambda item: file_names.order(item[0]))
        pairs = [(first, self._layout.partner(self._root, name)) for name, first in ordered]
        whole = [[deep, image] for deep, image in pairs if image and _at_rest(deep) and _at_rest(image)]
        found = color_placement(lambda index: self._frame("depth", whole[index], 0, 0), len(whole))
        if found is not None and found.camera is not None:
            self._depth.place = replace(found, frames_late=0)  # later frames are not there yet
            self.camera += f"; {self._depth.place}"

    def _find_camera(self, kind: str, first: Path, *, final: bool) -> bool:
        """Find the camera for images of the size of `first`, an image file. Return True if it is found."""
        assert self._layout is not None
        image = _image(first) if kind == "pair" else read_depth(first)
        size = image.shape[0], image.shape[1]
        given: Any = {"intrinsics": self._intrinsics, "calibration": self._calibration}
        try:
            if kind == "pair":
                self._camera, found = stereo_pairs.find_pairs(
                    self._root, size, baseline=self._baseline, places=self._places, **given
                )
                self.camera = str(found)
            else:
                self._camera = found = find_camera(self._root, size, places=self._places, **given)
                self._depth.usual_unit = self._layout.of.usual_unit
                self._depth.use_camera(found, self._depth_scale)
                self.camera = f"{found}; {self._depth.depth_unit}"
        except UnknownCamera as error:
            if final:
                need = " (of a stereo camera FILE, or intrinsics and baseline.txt)" if kind == "pair" else ""
                raise SourceError(f"{error}{need}") from error
        except DatasetError as error:  # it may be half written
            if final or self._calibration is not None:
                raise SourceError(str(error)) from error
        return self._camera is not None

    def _stamps(self, name: str, first: Path) -> tuple[int, int]:
        """Return a frame's `timestamp_ns`, which always grows, and `captured_ns`."""
        written_ns = first.stat().st_mtime_ns
        self._stamp = max(file_names.time_of(name) or written_ns, self._stamp + 1)
        own = written_ns >= self._opened_ns
        captured = monotonic_of(written_ns, oldest_s=_OLDEST_S) if own else time.monotonic_ns()
        return self._stamp, captured

    def _name_sensor(self) -> None:
        self.sensor = self._sensor or SENSORS[self._layout.kind if self._layout else "depth"]


def _image(path: Path) -> NDArray[Any]:
    return read_image(path, "an image", cv2.IMREAD_ANYCOLOR)


def _state(path: Path | None) -> tuple[int, int] | None:
    try:
        found = None if path is None else path.stat()
    except OSError:
        return None
    return None if found is None else (found.st_size, found.st_mtime_ns)


def _layout_of(root: Path) -> FolderLayout | None:
    """Return the layout of the files in a folder so far, or None if it is unknown."""
    return next((one for one in LAYOUTS if one.is_in(root)), None)


def _at_rest(path: Path) -> bool:
    with suppress(OSError):  # it was taken away
        return is_whole(path, is_at_rest=time.time() - path.stat().st_mtime > _AT_REST_S)
    return False


def is_whole(path: Path, *, is_at_rest: bool) -> bool:
    """Return True if a file is complete: by its end mark, or in a format without one, if `is_at_rest`."""
    if path.suffix.lower() in _ENDS:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - len(_PNG_END)))
            return file.read().endswith(_ENDS[path.suffix.lower()])
    nbytes = path.stat().st_size
    return is_at_rest and nbytes > 0 and not (path.suffix == ".bin" and nbytes % _POINT)
