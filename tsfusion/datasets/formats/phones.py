# SPDX-License-Identifier: MIT
"""Read recordings of phones and tablets with a LiDAR, as the usual apps export them.

ARKit gives all of them: colour, a small depth image registered to it, mostly its confidence (low, medium,
high), a camera for each frame, and poses in a world whose y axis points up. Apps write them differently.
"""

import logging
import re
import struct
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, needing
from tsfusion.datasets import readers
from tsfusion.datasets.dataset import WITHOUT_DEPTH, Times, partners_in_time
from tsfusion.datasets.file_names import order
from tsfusion.datasets.formats.image_folders import SUFFIXES, ListedFrames, Shot
from tsfusion.datasets.formats.nerfstudio import OPENGL
from tsfusion.datasets.readers import DEPTH_SUFFIXES, read_depth, read_image, read_lines, read_numbers
from tsfusion.datasets.trajectory_files import read_axis_angles, read_table, usable
from tsfusion.geometry.calibration import Camera, Size
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Gyroscope
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import rigid
from tsfusion.geometry.up_direction import GRAVITY

_MEDIUM = 64  # confidence of 8 bits from which it is not low; ARKit's own numbers are 0, 1 and 2
_SAME_S = 0.002  # two files of one frame have times this near
_FASTEST_NS, _SLOWEST_NS = 10**6, 10**11  # between two frames
_LEAST_MATCH = 3  # bytes that a match of LZFSE stands for; at most 2674, so that memory is bounded
_LEAST_HEADER = 32  # bytes of a block of LZFSE
_LIDAR = 256, 192  # height and width of an upright image, of versions that do not state them
_BROKEN = "with broken metadata"
_QUATERNION, _PINHOLE = ("qx", "qy", "qz", "qw"), ("fx", "fy", "cx", "cy")
_IMU = "`timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z` a line"
_R_PHONE = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])  # of ARKit's images, which lie on their side
_DAMAGE = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)  # of foreign values

log = logging.getLogger(__name__)


class PhoneFrames(ListedFrames):
    """Frames of depth in millimetres (integers) or metres (floats), each with a camera and pose of its own.

    Depth of low confidence counts as no depth. Up is known from the poses, so that a mesh stands upright.

    Args:
        confidence: False takes depth of low confidence, too.
        options: those of `ListedFrames`.
    """

    sensor = "tof"
    up = (0.0, 1.0, 0.0)  # in the world of the poses
    source = "metadata.json"  # file or folder with the cameras
    color_place = None  # ARKit registers depth to colour

    def __init__(self, path: str | Path, *, confidence: bool = True, **options: Any) -> None:
        self._confident = confidence
        super().__init__(path, **options)

    def _shots(self, root: Path) -> Iterable[Shot]:
        """Return the frames with a depth image, in order."""
        raise NotImplementedError

    def _list(self, root: Path) -> tuple[list[Any], Times]:
        try:
            shots = [*self._shots(root)]
        except _DAMAGE as error:
            raise self._damaged(root / self.source, error) from error
        seconds = np.array([shot.seconds for shot in shots])
        if not shots or not ((seconds >= 0) & (seconds < 2**33)).all():
            return shots, None
        stamps = np.rint(seconds * 1e9).astype(np.int64)
        steps = np.diff(stamps)
        is_rising = steps.min(initial=1) > 0
        is_time = not len(steps) or _FASTEST_NS <= np.median(steps) <= _SLOWEST_NS
        return shots, stamps if is_rising and is_time else None

    def _posed_frame(self, index: int, **measurement: Any) -> Frame:
        """Return a frame whose specific force is gravity's reaction, by the recorded pose."""
        T = self._poses[index]
        force = None if T is None else T[:3, :3].T @ np.array(self.up) * GRAVITY
        return super()._posed_frame(index, specific_force=force, **measurement)

    def _stored(self, file: Any) -> NDArray[Any]:
        depth = self._depth(file.depth)
        if file.confidence is None or not self._confident:
            return depth
        levels = self._levels(file.confidence)
        if levels.shape != depth.shape:
            raise DatasetError(
                f"{file.confidence} is {levels.shape[1]}×{levels.shape[0]}, its depth "
                f"{depth.shape[1]}×{depth.shape[0]}; expected equal sizes (--option confidence=false)"
            )
        low = levels < (_MEDIUM if levels.max(initial=0) > 2 else 1)
        if low.all():
            raise DatasetError(
                f"{file.confidence} is low everywhere (--option confidence=false takes such depth)"
            )
        depth[low] = 0
        return depth

    def _depth(self, file: Any) -> NDArray[Any]:
        return read_depth(file, invalid=self.not_measured)

    def _levels(self, file: Any) -> NDArray[Any]:
        levels = read_image(file, "confidence")
        return levels if levels.ndim == 2 else levels[:, :, 0]

    def _damaged(self, file: Any, error: Exception) -> DatasetError:
        why = f"no {error}" if isinstance(error, KeyError) else f"{error}"
        return DatasetError(f"{file} is damaged ({why}); expected {self.expected}")

    def _whole(self, root: Path, names: list[str], read: Callable[[str], Shot]) -> list[Shot]:
        """Return the frames that `read` can read, and count the others; raise if these are most."""

        def checked(name: str) -> Shot:
            try:
                return read(name)
            except _DAMAGE as error:
                raise self._damaged(f"{root}, frame {name}: {self.source}", error) from error

        found = [shot for shot in usable(root, names, checked, "frames") if shot is not None]
        if len(found) < len(names):
            self.skipped[_BROKEN] = len(names) - len(found)
        return found

    def _with_depth(
        self, depth: dict[str, Any], others: Iterable[str], *, numbered: bool = False
    ) -> list[str]:
        """Return the names of the depth images, and count frames that have none."""
        if other := next((file for stem, file in depth.items() if numbered and not stem.isdecimal()), None):
            raise DatasetError(f"{other} is not named by a frame number; expected {self.expected}")
        if missing := len({*others} - {*depth}):
            self.skipped[WITHOUT_DEPTH] = missing
        return [*depth]


class Record3D(PhoneFrames):
    """A recording of Record3D: its EXR and JPEG export, or the `.r3d` file itself.

    https://record3d.app. Poses (qx qy qz qw x y z) are camera-to-world with OpenGL axes. `K` is by columns.
    A `.r3d` is a zip of `metadata` and `rgbd/N.jpg`, `.depth`, `.conf` (LZFSE). Options are those of
    `PhoneFrames`.
    """

    layout = "Record3D"
    expected = "metadata.json with w, h, K and poses, depth/N.exr and rgb/N.jpg; or a .r3d file (lzfse)"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a `.r3d` file, and for a folder with its content or with the app's export."""
        if path.is_file():
            return path.suffix.lower() == ".r3d"
        file = _metadata(path)
        if file is None or not any((path / name).is_dir() for name in ("depth", "rgbd")):
            return False
        with file.open("rb") as opened:
            start = opened.read(1 << 22)
        return b'"K"' in start or b'"perFrameIntrinsicCoeffs"' in start

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        path = Path(path).expanduser()
        self._place: Any = path
        if not path.is_file():
            return super()._opened(path, trajectory)
        try:
            self._place = zipfile.Path(zipfile.ZipFile(path))
        except (zipfile.BadZipFile, OSError, ValueError) as error:
            raise DatasetError(
                f"{path} is no whole .r3d file, which is a zip ({error}); copy it again"
            ) from error
        return path, super()._opened(path.parent, trajectory)[1]

    def _shots(self, root: Path) -> Iterable[Shot]:
        place, file = self._place, _metadata(self._place)
        if file is None:
            raise DatasetError(f"{root} holds no metadata; expected {self.expected}")
        said = readers.read_json(file)
        packed = place / "rgbd"
        if packed.is_dir():
            depth, color = _by_stem(packed, (".depth",)), _by_stem(packed, SUFFIXES)
            sure = _by_stem(packed, (".conf",))
        else:
            depth = _by_stem(place / "depth", (*DEPTH_SUFFIXES, ".depth"))
            color = _first(_by_stem(place / name, SUFFIXES) for name in ("rgb", "color", "images"))
            sure = _first(_by_stem(place / name, (*SUFFIXES, ".conf")) for name in ("confidence", "conf"))
        size, fps = (int(said["h"]), int(said["w"])), float(said.get("fps") or 0)
        usual = _LIDAR if size[0] > size[1] else _LIDAR[::-1]
        self._shape = int(said.get("dh", usual[0])), int(said.get("dw", usual[1]))
        K = _matrix3(said["K"]) if said.get("K") is not None else None
        for stem in self._with_depth(depth, color, numbered=True):
            number = int(stem)
            own, pose = _row(said, "perFrameIntrinsicCoeffs", number, 4), _row(said, "poses", number, 7)
            time = said.get("frameTimestamps") or []
            seconds = float(time[number]) if number < len(time) else number / fps if fps > 0 else -1.0
            lens = K if own is None else own
            yield Shot(
                depth[stem], _of_frame(color, stem), _of_frame(sure, stem),
                None if lens is None else Camera.named(lens, size, "pinhole"),
                None if pose is None else _rigid(pose[:4], pose[4:]) @ OPENGL,
                seconds if not time or number < len(time) else -1.0,
            )  # fmt: skip

    def _depth(self, file: Any) -> NDArray[Any]:
        if not file.name.endswith(".depth"):
            return super()._depth(file)
        return _unpacked(file, self._shape, (np.dtype("<f4"), np.dtype("<f2"))).astype(np.float32)

    def _levels(self, file: Any) -> NDArray[Any]:
        if not file.name.endswith(".conf"):
            return super()._levels(file)
        return _unpacked(file, self._shape, (np.dtype("u1"),))


class StrayScanner(PhoneFrames):
    """A recording of Stray Scanner: depth and confidence images, poses in `odometry.csv`, colour as a video.

    https://github.com/strayrobots/scanner. Poses are camera-to-world with OpenCV axes. A line of
    `odometry.csv` has the number of its frame, and in newer versions its camera. `imu.csv` has Core Motion's
    angular velocities, rad/s, in the phone's axes (x right, y up, z to the user). Options are those of
    `PhoneFrames`.
    """

    layout = "Stray Scanner"
    expected = "odometry.csv, camera_matrix.csv, depth/*.png or .npy, confidence/*.png and rgb.mp4 (or rgb/)"
    source = "camera_matrix.csv"
    signs = (("depth",), ("odometry.csv", "camera_matrix.csv"), ("confidence", "rgb.mp4", "rgb"))

    def _shots(self, root: Path) -> Iterable[Shot]:
        self._gyroscope = read_table(Gyroscope(_R_PHONE), root / "imu.csv", _IMU, separator=",", first=4)
        path = root / "odometry.csv"
        lines = _odometry(path, self.expected) if path.is_file() else {}
        images = _by_stem(root / "rgb", SUFFIXES)
        self._video = None if images or not (root / "rgb.mp4").is_file() else Video(root / "rgb.mp4")
        shown = self._images_of(self._video, lines) if self._video else None
        first = next(iter(images.values()), None)
        size = self._video.size if self._video else self._image(first).shape[:2] if first else None
        path = root / "camera_matrix.csv"
        K = _matrix3(read_numbers(path, "a 3×3 camera matrix")) if path.is_file() else None
        depth, sure = _by_stem(root / "depth", DEPTH_SUFFIXES), _by_stem(root / "confidence", SUFFIXES)
        for stem in self._with_depth(depth, images, numbered=True):
            line = lines.get(number := int(stem), {})
            own = [line[name] for name in _PINHOLE] if "fx" in line else K
            q, t = ([line.get(name, np.nan) for name in names] for names in (_QUATERNION, "xyz"))
            image = number if shown is None else shown.get(number)
            yield Shot(
                depth[stem], image if self._video else _of_frame(images, stem), _of_frame(sure, stem),
                None if own is None or size is None else Camera.named(own, size, "pinhole"),
                _rigid(np.array(q), np.array(t)) if line else None, line.get("timestamp", -1.0),
            )  # fmt: skip

    def _images_of(self, video: "Video", lines: dict[int, dict[str, float]]) -> dict[int, int | None] | None:
        """Return the number of the image of each frame's time, if the video lacks images; else None.

        Raises:
            DatasetError: the video lacks images, and times do not tell which.
        """
        numbers = sorted(lines)
        if not numbers or video.count > numbers[-1]:
            return None
        times = np.array([lines[number].get("timestamp", 0.0) for number in numbers])  # seconds
        said = f"{video.path} has {video.count} images for frames up to {numbers[-1]}"
        found: list[int | None] = [None]
        if (np.abs(times) < 2**33).all() and times[0] < times[-1]:
            stamps = np.rint(1e9 * times).astype(np.int64)
            half_a_step = int(np.median(np.diff(stamps))) // 2
            found = partners_in_time(video.times_ns(), stamps - stamps[0], half_a_step)
        if found[-1] is None:  # in a video without gaps, images after a lacking one are a neighbour's
            raise DatasetError(
                f"{said}, and times do not tell which frames have none; expected an image a frame (--option "
                "color=false leaves colour out)"
            )
        log.warning("%s: paired by time (--option color=false leaves colour out)", said)
        return dict(zip(numbers, found, strict=True))

    def _image(self, color: Any) -> NDArray[np.uint8]:
        if isinstance(color, int) and self._video is not None:
            return self._video.frame(color)
        return super()._image(color)


class Polycam(PhoneFrames):
    """The raw data of a Polycam capture in LiDAR or room mode.

    https://github.com/PolyCam/polyform. Poses (`t_00` to `t_23`, by rows) are camera-to-world with OpenGL
    axes; those corrected by Polycam are taken where they are, with the corrected images. Names are
    microseconds. Options are those of `PhoneFrames`.
    """

    layout, source = "Polycam", "cameras/*.json"
    expected = "keyframes/ with images/*.jpg, depth/*.png, cameras/ or corrected_cameras/*.json, confidence/"
    _CAMERAS = ("corrected_cameras", "cameras")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a capture's folder, and for its `keyframes/`."""
        place = cls._place(path)
        return (place / "depth").is_dir() and any((place / name).is_dir() for name in cls._CAMERAS)

    @staticmethod
    def _place(path: Path) -> Path:
        return path / "keyframes" if (path / "keyframes").is_dir() else path

    def _shots(self, root: Path) -> Iterable[Shot]:
        place = self._place(root)
        cameras = _first(_by_stem(place / name, (".json",)) for name in self._CAMERAS)
        is_corrected = next(iter(cameras.values()), place).parent.name == self._CAMERAS[0]
        names = ("corrected_images", "images")[0 if is_corrected else 1 :]
        images = _first(_by_stem(place / name, SUFFIXES) for name in names)
        depth, sure = _by_stem(place / "depth", DEPTH_SUFFIXES), _by_stem(place / "confidence", SUFFIXES)

        def read(stem: str) -> Shot:
            lens = matrix = None
            if stem in cameras:
                said = readers.read_json(cameras[stem])
                size, K = (int(said["height"]), int(said["width"])), [said[name] for name in _PINHOLE]
                rows = [[float(said[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
                lens, matrix = Camera.named(K, size, "pinhole"), np.array([*rows, [0, 0, 0, 1]]) @ OPENGL
            seconds = int(stem) * 1e-6 if stem.isdecimal() else -1.0
            return Shot(depth[stem], _of_frame(images, stem), _of_frame(sure, stem), lens, matrix, seconds)

        return self._whole(root, self._with_depth(depth, cameras), read)


class ScannerApp(PhoneFrames):
    """The "all data" export of the 3D Scanner App: images and a `.json` for each frame, in one folder.

    https://3dscannerapp.com. `cameraPoseARFrame` is camera-to-world with OpenGL axes, by rows. Colour is
    there for some of the frames. Options are those of `PhoneFrames`.
    """

    layout, source = "3D Scanner App", "frame_*.json"
    expected = "frame_*.json, depth_*.png, conf_*.png and frame_*.jpg"
    signs = (("frame_*.json",), ("depth_*.png", "depth_*.tiff", "depth_*.exr"))

    def _shots(self, root: Path) -> Iterable[Shot]:
        cameras, color = (_by_stem(root, suffixes, "frame_") for suffixes in ((".json",), SUFFIXES))
        depth, sure = _by_stem(root, DEPTH_SUFFIXES, "depth_"), _by_stem(root, SUFFIXES, "conf_")
        size = self._image(next(iter(color.values()))).shape[:2] if color else None

        def read(stem: str) -> Shot:
            lens = matrix = None
            said = readers.read_json(cameras[stem]) if stem in cameras else {}
            if said.get("intrinsics") is not None and size is not None:
                lens = Camera.named(_matrix3(said["intrinsics"]), size, "pinhole")
            if said.get("cameraPoseARFrame") is not None:
                given = np.array(said["cameraPoseARFrame"], np.float64).reshape(4, 4)
                matrix = (given.T if given[3, :3].any() and not given[:3, 3].any() else given) @ OPENGL
            return Shot(
                depth[stem], color.get(stem), _of_frame(sure, stem), lens, matrix,
                float(said.get("time", -1.0)),
            )  # fmt: skip

        return self._whole(root, self._with_depth(depth, color), read)


class ARKitScenes(PhoneFrames):
    """A raw scene of ARKitScenes, or of its 3D object detection set, at the size of the depth images.

    https://github.com/apple/ARKitScenes. A line of `lowres_wide.traj` is a time, an axis times an angle, and
    a translation: world to camera, OpenCV axes, z up in the world. Names of files are VIDEO_SECONDS. Options
    are those of `PhoneFrames`.
    """

    layout, source, up = "ARKitScenes", "lowres_wide_intrinsics/*.pincam", (0.0, 0.0, 1.0)
    expected = "lowres_wide.traj, lowres_depth/, lowres_wide/, lowres_wide_intrinsics/*.pincam, confidence/"
    signs = (("lowres_depth",), ("lowres_wide.traj", "lowres_wide_intrinsics"))

    def _shots(self, root: Path) -> Iterable[Shot]:
        depth = _by_stem(root / "lowres_depth", DEPTH_SUFFIXES)
        kinds = {"lowres_wide": SUFFIXES, "confidence": SUFFIXES, "lowres_wide_intrinsics": (".pincam",)}
        color, sure, cameras = (_by_stem(root / name, suffixes) for name, suffixes in kinds.items())
        path = root / "lowres_wide.traj"
        along = read_axis_angles(path) if path.is_file() else None
        times = [
            {_number(stem.rpartition("_")[2]): stem for stem in found} for found in (color, sure, cameras)
        ]

        def read(stem: str) -> Shot:
            seconds = _number(stem.rpartition("_")[2])
            image, level, camera = (
                _of_frame(found, _near(own, stem, seconds))
                for found, own in zip((color, sure, cameras), times, strict=True)
            )
            lens = None
            if camera is not None:
                w, h, *K = read_numbers(camera, "width height fx fy cx cy", columns=6)[0]
                lens = Camera.named(K, (int(h), int(w)), "pinhole")
            gap = {"max_gap_ns": round(self._gap_s * 1e9)}
            is_timed = along is not None and np.isfinite(seconds)
            matrix = along.at(round((seconds + self._offset_s) * 1e9), **gap) if along and is_timed else None
            return Shot(depth[stem], image, level, lens, matrix, seconds)

        return self._whole(root, self._with_depth(depth, ()), read)


class Video:
    """Images of a video in a file, by number; they are read in order, and from the start after a step back.

    Raises:
        DatasetError: the file or one of its images cannot be decoded.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._next = path, 0
        self._capture: Any = None  # None = not open
        self.count = 0  # of images, as the file states
        self.size: Size = self.frame(0).shape[:2]

    def times_ns(self) -> list[int]:
        """Return the time of each image after the first, nanoseconds. All of them are decoded for it."""
        capture, times = self._opened(), list[int]()
        while capture.grab():
            times.append(round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        return [time - times[0] for time in times]

    def _opened(self) -> Any:
        capture = cv2.VideoCapture(str(self.path))
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return image `number`, (h, w, 3) BGR, as stored."""
        if self._capture is None or number < self._next:
            self._capture, self._next = self._opened(), 0
            self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        while self._next < number and self._capture.grab():
            self._next += 1
        good, image = self._capture.read() if self._next == number else (False, None)
        if not good or image is None:
            self._capture = None
            raise DatasetError(f"{self.path} has no image {number}; expected an image a frame")
        self._next += 1
        return np.asarray(image, np.uint8)


def _metadata(place: Any) -> Any:
    return next((file for name in ("metadata.json", "metadata") if (file := place / name).is_file()), None)


def _by_stem(place: Any, suffixes: tuple[str, ...], start: str = "") -> dict[str, Any]:
    """Return the files of a folder, or of one in a zip, by name without `start` and suffix, in order.

    Names that differ from most in more than their numbers are left out.
    """
    found = {}
    for file in place.iterdir() if place.is_dir() else ():
        stem, _, suffix = file.name.rpartition(".")
        if stem.startswith(start) and not stem.startswith(".") and f".{suffix.lower()}" in suffixes:
            found[stem.removeprefix(start)] = file
    kinds = {stem: "#".join(re.split(r"[0-9]+(?:\.[0-9]+)?", stem)) for stem in found}
    usual = Counter(kinds.values()).most_common(1)
    return {stem: found[stem] for stem in sorted(found, key=order) if kinds[stem] == usual[0][0]}


def _first(found: Iterable[dict[str, Any]]) -> dict[str, Any]:
    return next(filter(None, found), {})


def _of_frame(files: dict[str, Any], stem: str) -> Any:
    """Return a frame's file; None if the recording has none, a missing one if only this frame lacks it."""
    first = next(iter(files.values()), None)
    return (
        None if first is None else files.get(stem, first.parent / f"{stem}.{first.name.rpartition('.')[2]}")
    )


def _number(word: str) -> float:
    """Return the number in a word; NaN if it is none."""
    try:
        return float(word)
    except ValueError:
        return float("nan")


def _near(times: dict[float, str], stem: str, seconds: float) -> str:
    """Return the name with a time within 2 ms, or the name itself."""
    if seconds in times or not times:
        return times.get(seconds, stem)
    nearest = min(times, key=lambda one: abs(one - seconds))
    return times[nearest] if abs(nearest - seconds) <= _SAME_S else stem


def _odometry(path: Path, expected: str) -> dict[int, dict[str, float]]:
    """Return the named values of each frame's line; names are in the first line, or those of old versions."""
    lines = [[word.strip() for word in line.split(",")] for _, line in read_lines(path, expected)]
    names = ["x", "y", "z", *_QUATERNION]
    if lines and not lines[0][-1].lstrip("-").replace(".", "").isdigit():
        names = lines.pop(0)
    elif lines and len(lines[0]) > len(names):
        names = ["timestamp", "frame", *names]
    found = {}
    for index, words in enumerate(lines):
        line = {name: _number(word) for name, word in zip(names, words, strict=False)}
        number = line.get("frame", float(index))
        if len(words) == len(names) and np.isfinite(number):
            found[int(number)] = line
    if not found:
        raise DatasetError(f"{path} has no lines of {', '.join(names)}; expected {expected}")
    return found


def _row(said: dict[str, Any], name: str, number: int, length: int) -> NDArray[np.float64] | None:
    """Return a row of a table in JSON; None if it is missing, NaN if it is malformed."""
    table = said.get(name) or []
    if number >= len(table):
        return None
    row = np.array(table[number], np.float64)
    return row if row.shape == (length,) else np.full(length, np.nan)


def _matrix3(values: Any) -> NDArray[np.float64]:
    """Return a (3, 3) camera matrix of nine numbers by rows, or by columns as Apple has them."""
    K = np.array(values, np.float64).reshape(3, 3)
    return K.T if K[2, :2].any() and not K[:2, 2].any() else K


def _rigid(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> Transform:
    length = np.linalg.norm(quaternion)
    return rigid(quaternion / length if abs(length - 1) < 0.01 else quaternion * np.nan, translation)


def _unpacked(file: Any, shape: Size, kinds: tuple[np.dtype[Any], ...]) -> NDArray[Any]:
    """Return the array of a file, packed by LZFSE or not; it is of the first kind that fits the size."""
    content = readers.read_content(file)
    pixels = shape[0] * shape[1]
    nbytes, matches = _promised(content, file) if content[:3] == b"bvx" else (len(content), 0)
    kind = next((kind for kind in kinds if pixels > 0 and kind.itemsize * pixels == nbytes), None)
    if kind is None or _LEAST_MATCH * matches > nbytes:
        raise DatasetError(f"{file} holds {nbytes} bytes; expected {shape[1]}×{shape[0]} pixels (dw, dh)")
    limits.check(file, nbytes)
    if content[:3] == b"bvx":
        with needing(f"{file}: a .r3d file needs lzfse: pip install '.[phone]'"):
            import lzfse
        try:
            content = lzfse.decompress(content)
        except (lzfse.error, ValueError, MemoryError) as error:
            raise DatasetError(f"{file} is damaged ({error})") from error
    if len(content) != nbytes:
        raise DatasetError(f"{file} is damaged: {len(content)} of {nbytes} bytes")
    return np.array(np.frombuffer(content, kind).reshape(shape))


def _promised(packed: bytes, file: Any) -> tuple[int, int]:
    """Return the bytes that LZFSE blocks unpack to, and their matches, from their headers alone."""
    at, nbytes, matches = 0, 0, 0
    try:
        while (name := packed[at : at + 4]) != b"bvx$":
            nbytes += struct.unpack_from("<I", packed, at + 4)[0]
            if name == b"bvx-":
                at += 8 + struct.unpack_from("<I", packed, at + 4)[0]
            elif name == b"bvxn":
                at += 12 + struct.unpack_from("<I", packed, at + 8)[0]
            elif name == b"bvx2":
                first, second, third = struct.unpack_from("<3Q", packed, at + 8)
                matches += first >> 40 & 0xFFFFF
                at += (
                    max(_LEAST_HEADER, third & 0xFFFFFFFF)
                    + (first >> 20 & 0xFFFFF)
                    + (second >> 40 & 0xFFFFF)
                )
            else:
                raise DatasetError(f"{file} is cut off or no LZFSE")
    except struct.error as error:
        raise DatasetError(f"{file} is cut off") from error
    return nbytes, matches
