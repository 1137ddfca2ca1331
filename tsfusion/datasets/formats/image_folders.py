# SPDX-License-Identifier: MIT
"""Read folders of images: depth and colour (base class of layouts), or the pairs of a stereo camera."""

import copy
import logging
import os
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import readers
from tsfusion.datasets.cameras import (
    GIVE,
    MILLIMETRES,
    PublishedCamera,
    RecordedCamera,
    UnknownCamera,
    find_camera,
    given_camera,
)
from tsfusion.datasets.color_placement import ColorPlace, color_placement
from tsfusion.datasets.dataset import SCAN, FramePoses, NoPoses, Times, first_frame
from tsfusion.datasets.file_names import in_order, in_time, numbers_in, series_of
from tsfusion.datasets.folder_frames import FolderFrames
from tsfusion.datasets.readers import check_metres, read_color, read_depth, read_lines, turned_by_exif
from tsfusion.datasets.stereo_pairs import PairedImages, find_pairs, paired
from tsfusion.datasets.trajectory_files import checked_pose, read_matrix, read_matrix_rows, usable
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

log = logging.getLogger(__name__)

SUFFIXES = (".png", ".jpg", ".jpeg")
_SIZES = 3  # images used to find the size of all
_FIRST_TRIES = 50  # so many unreadable images, with no readable one, mean that all are
FEW_LEFT = 0.05  # share: with more poses left over, a recording was cut rather than numbered anew
COLOR = ("color", "colour", "rgb", "image", "images")  # folders beside depth/, in order of preference
EXPECTED = (
    "left/ and right/ with images of equal names; K.txt and baseline.txt (metres) if rectified, else "
    "left.yaml and right.yaml or --calibration; and poses of the left camera with --trajectory"
)
_SIDES = ("left", "right")


class ImagesAt(NamedTuple):
    """Images of one kind in a layout: folders in order of preference, and file names without suffix.

    In a name, {} stands for the part that all files of a frame share.
    """

    places: tuple[str, ...]
    name: str = "{}"

    def folders(self, root: Path) -> list[Path]:
        """Return the folders of the first of `places` that exists; several if it is a pattern."""
        found = ([path for path in _places(root, place) if path.is_dir()] for place in self.places)
        return next(filter(None, found), [])

    def folder(self, root: Path) -> Path:
        """Return the first folder of `folders`, or the folder that is expected if none exists."""
        return next(iter(self.folders(root)), root / self.places[0])

    def files(self, root: Path, expected: str, suffixes: tuple[str, ...]) -> list[Path]:
        """Return the images in the order of the numbers in their names, without hidden files."""
        return _files(
            self.folder(root), expected, self.name.format("*" if self.name != "{}" else "[!.]*"), suffixes
        )

    def shared(self, stem: str) -> str:
        """Return the part of an image's name that the other files of its frame share."""
        before, after = self.name.split("{}")
        return stem.removeprefix(before).removesuffix(after)


class PoseRows(NamedTuple):
    """Layout of poses: one file, a 4×4 matrix a line, for the image with the line's number or the k-th."""

    file: str
    by_number: bool = False

    def read(self, root: Path, files: list[Path], images: ImagesAt) -> FramePoses:
        """Return the pose of each image. Raises NoPoses without the file."""
        path = root / self.file
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected 16 numbers a line; {SCAN}")
        poses = read_matrix_rows(path)
        if self.by_number:
            return poses_by_number([file.stem for file in files], [*enumerate(poses)], path)
        if len(poses) != len(files):
            raise DatasetError(
                f"{path} has {len(poses)} poses for {len(files)} depth images; "
                "expected as many: line k belongs to the k-th image"
            )
        return poses


class PoseFiles(NamedTuple):
    """Layout of poses: a file with a 4×4 matrix for each image, in a separate folder or beside the image."""

    file: str  # with {} as in `ImagesAt`

    def read(self, root: Path, files: list[Path], images: ImagesAt) -> FramePoses:
        """Return the pose of each image, or None if its file is missing or the tracker was lost (inf)."""
        is_apart = "/" in self.file

        def pose(image: Path) -> Transform | None:
            path = (root if is_apart else image.parent) / self.file.format(images.shared(image.stem))
            if not path.exists():
                return None
            lost = any("inf" in line.lower() for _, line in read_lines(path, "a 4×4 camera-to-world matrix"))
            return None if lost else read_matrix(path)

        return usable((root / self.file).parent, files, pose)


class DepthReader:
    """Reader of one camera's depth images, and of colour for the same pixels."""

    camera: RecordedCamera
    usual_unit = MILLIMETRES
    not_measured: int | None = None  # a value that means "no depth", besides 0
    place: ColorPlace | None = None  # of colour that is registered by whoever reads; None = as it is

    def use_camera(self, camera: RecordedCamera, depth_scale: float | None) -> None:
        """Set the camera of the images. Call it before the first image is read.

        Args:
            camera: its distortion is removed from depth and colour.
            depth_scale: metres per unit. None = as stated by the camera's file, else `usual_unit`, for
                integers; floats are metres.
        """
        self.camera, self.intrinsics = camera, camera.intrinsics
        self.depth_unit = camera.depth_unit(depth_scale, self.usual_unit)
        self.depth_scale = self.depth_unit.metres
        self._float_scale = 1.0 if depth_scale is None else depth_scale
        self._kind: np.dtype[Any] | None = None  # type of the first depth image read

    def read(self, depth: Path, color: Path | None) -> dict[str, Any]:
        """Return fields of a `Frame`. Raises DatasetError for an image unlike the others in size or kind."""
        measured = self._measured(depth)
        return {
            "depth": measured,
            "depth_scale": self.depth_scale,
            "color": None if color is None else self._registered(color, measured),
            "intrinsics": self.intrinsics,
        }

    def _stored(self, file: Any) -> NDArray[Any]:
        """Return a file's depth as `read_depth` does."""
        return read_depth(file, invalid=self.not_measured)

    def _measured(self, file: Any) -> NDArray[Any]:
        """Return a file's undistorted depth: uint16 in `depth_scale` metres, or float32 metres."""
        return self.camera.depth(self._checked_depth(file))

    def _checked_depth(self, file: Any) -> NDArray[Any]:
        """Return a file's depth, of the size and kind of the others."""
        depth, size = self._stored(file), self.camera.size
        self._kind = self._kind or depth.dtype
        if depth.shape != size:
            raise DatasetError(
                f"{file} is {depth.shape[1]}×{depth.shape[0]}, others are {size[1]}×{size[0]}; "
                "expected one size, as there is one camera"
            )
        if depth.dtype != self._kind:
            raise DatasetError(f"{file} holds {depth.dtype}, others {self._kind}; expected one kind of depth")
        if depth.dtype == np.float32:
            depth *= np.float32(self._float_scale)
            check_metres(depth, file)
        return depth

    def _registered(self, color: Path, depth: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the colour of each depth pixel: (H, W, 3) uint8 BGR."""
        return np.asarray(self.camera.color(read_color(color, depth.shape)), np.uint8)


class DepthImages(DepthReader, FolderFrames):
    """Frames of one depth image each, with colour and a pose if recorded.

    A layout sets attributes: `depth_at`, `color_at`, `poses_at`, `camera_at` (camera files in order of
    preference) and `published`. It overrides methods for the rest: `_registered` decides how colour fits.

    Args:
        intrinsics, calibration: of the depth images, instead of a camera file in the folder (`cameras.FILES`)
            or the camera published by a benchmark; distortion is removed.
        depth_scale: metres per unit; default as stated by a camera file, else as usual in the layout, and 1
            for floats.
        color: True reads colour images.
        register: True moves colour onto the depth where edges show that another camera took it
            (`color_placement`). False takes it as it is.
        options: those of `FolderFrames`.

    Raises:
        DatasetError: most images are missing, the camera is unknown or malformed; and as for `FolderFrames`.
    """

    sensor = "kinect"
    depth_at = ImagesAt(("depth",))
    color_at: ImagesAt | None = None
    poses_at: PoseRows | PoseFiles
    camera_at: tuple[str, ...] = ()
    published: PublishedCamera | None = None

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        depth_scale: float | None = None,
        color: bool = True,
        register: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(path, **options)
        self._register = register
        self._color = self._colors(self._root) if color else []
        self.uncolored = [*self._color].count(None)
        given = {"intrinsics": intrinsics, "calibration": calibration}
        camera = self._find_camera(self._root, first_size(self._files, self._stored), depth_scale, **given)
        self.use_camera(camera, depth_scale)

    def frame(self, index: int) -> Frame:
        place = self.color_place  # it may pair colour anew
        measured = super().frame(index)
        return measured if place is None else place.registered(measured)

    @cached_property
    def color_place(self) -> ColorPlace | None:
        """Place and time of colour, if edges in all frames show that it does not lie on the depth; None if it
        does, if that is unclear, or without `register`."""
        if not (self._register and self._color):
            return None
        whole = self._unposed()
        place = color_placement(whole._frame, len(whole))
        if place is not None and place.frames_late:
            others = (index + place.frames_late for index in self._kept)
            self._color = [whole._color[each] if 0 <= each < len(whole) else None for each in others]
        return place

    def _unposed(self) -> "DepthImages":
        """Return a copy with all frames and no poses, to look for the colour camera; it counts for itself."""
        found = copy.copy(self)
        found.skipped = {}
        found._files, found.timestamps_ns = found._list(self._root)
        everything, where = range(len(found._files)), (self._root, self.expected)
        found._kept = found._keep(everything, [None] * len(everything), where, posed=False)
        found._color = found._colors(self._root)
        return found

    def _list(self, root: Path) -> tuple[list[Any], Times]:
        return depth_images(root, self.depth_at, self.expected), None

    def _recorded_poses(self, root: Path, files: list[Any]) -> FramePoses:
        return self.poses_at.read(root, files, self.depth_at)

    def _colors(self, root: Path) -> Sequence[Path | None]:
        """Return a colour image or None for each depth image; empty without any colour."""
        if self.color_at is None:
            return []
        return color_images(self._files, root, (self.depth_at, self.color_at), self.expected)

    def _find_camera(self, root: Path, size: Size, depth_scale: float | None, **given: Any) -> RecordedCamera:
        """Return the camera of the depth images; `given` are intrinsics and calibration."""
        return find_camera(root, size, **given, **self._known_camera(root))

    def _known_camera(self, root: Path) -> dict[str, Any]:
        """Return what the layout knows of its camera: `places`, `files` and `published` for `find_camera`."""
        places = (Path(os.path.normpath(root / file)) for file in self.camera_at)
        return {"files": [path for path in places if path.is_file()][:1], "published": self.published}

    def _frame(self, index: int) -> Frame:
        color = self._color[index] if self._color else None
        return self._posed_frame(index, **self.read(self._files[index], color))


class Shot(NamedTuple):
    """One frame, as a recording lists it. A file is a path in a folder or in a zip."""

    depth: Any
    color: Any = None  # a file, or the frame's number in a video
    confidence: Any = None
    lens: Any = None  # camera of the colour image, or what the layout makes it of
    matrix: Any = None  # (4, 4) T_world_camera, not checked
    seconds: float = -1.0  # negative = not known
    where: str = ""  # for errors, if not the depth's file

    def __str__(self) -> str:
        return self.where or str(self.depth)


class ListedFrames(DepthImages):
    """Frames with a camera and a pose each, as a recording lists them (`Shot`).

    Colour is resampled to the pixels of depth by the frame's camera, whose lens distortion is removed.

    Args:
        intrinsics, calibration: of the depth images of all frames, instead of the recording's.
        options: those of `DepthImages`.
    """

    source = ""  # file or folder with the cameras
    _given: Camera | None = None  # used instead of the recording's

    def __init__(self, path: str | Path, **options: Any) -> None:
        self._undistorters: dict[Camera, Undistorter] = {}
        super().__init__(path, **options)

    def _recorded_poses(self, root: Path, files: list[Any]) -> FramePoses:
        if all(shot.matrix is None for shot in files):
            raise NoPoses(f"{root} has no poses; expected {self.expected}; {SCAN}")
        return usable(root, files, lambda shot: None if shot.matrix is None else self._pose(shot))

    def _pose(self, shot: Shot) -> Transform:
        """Return the checked pose of a frame with a matrix."""
        return checked_pose(shot.matrix, shot)

    def _lens(self, shot: Shot, size: Size) -> Camera | None:
        """Return the camera of a frame whose image, or depth, has this size; None = not known."""
        found: Camera | None = shot.lens
        return found

    def _image(self, color: Any) -> NDArray[np.uint8]:
        """Return a colour image in its own size, (h, w, 3) BGR."""
        return read_color(color, None)

    def _colors(self, root: Path) -> Sequence[Any]:
        colors = [shot.color for shot in self._files]
        return colors if any(color is not None for color in colors) else []

    def _find_camera(self, root: Path, size: Size, depth_scale: float | None, **given: Any) -> RecordedCamera:
        """Return the given camera, which is then used for all frames; else that of the first frame."""
        found = given_camera(size, **given)
        if found is not None:
            self._given = found.lens
            return found
        self.use_camera(RecordedCamera(Intrinsics(1.0, 1.0, 0.0, 0.0), size, ""), depth_scale)
        first = first_frame(self).intrinsics
        assert first is not None
        undistorted = ", undistorted" if self._undistorters else ""
        return RecordedCamera(first, size, f"from {self.source}{undistorted}")

    def _frame(self, index: int) -> Frame:
        shot = self._files[index]
        depth = self._checked_depth(shot)
        file = self._color[index] if self._color else None
        color = None if file is None else self._image(file)
        lens = self._given or self._lens(shot, _size(depth if color is None else color))
        if lens is None:
            raise UnknownCamera(f"{shot}: no camera in {self.source}; expected {self.expected}; {GIVE}")
        fitted = fitted_camera(lens, depth.shape, str(shot))
        if color is not None and color.shape[:2] != depth.shape:
            if turned := isinstance(file, Path) and turned_by_exif(file, color.shape, lens.size):
                raise DatasetError(f"{file}: {turned}")
            own = fitted_camera(lens, color.shape, str(shot))
            color = resample_for_camera(color, own.intrinsics, fitted.intrinsics, depth.shape)
        intrinsics = fitted.intrinsics
        if not fitted.is_pinhole:
            undistorter = self._undistorter(fitted)
            intrinsics, depth = undistorter.intrinsics, undistorter.depth(depth)
            color = None if color is None else np.asarray(undistorter.image(color), np.uint8)
        return self._posed_frame(
            index, depth=depth, depth_scale=self.depth_scale, color=color, intrinsics=intrinsics
        )

    def _undistorter(self, camera: Camera) -> Undistorter:
        if camera not in self._undistorters:
            self._undistorters.clear()  # a different camera for each frame would fill the memory
            self._undistorters[camera] = Undistorter(camera)
        return self._undistorters[camera]


def _size(image: NDArray[Any]) -> Size:
    return image.shape[0], image.shape[1]


def fitted_camera(camera: Camera, shape: tuple[int, ...], where: str) -> Camera:
    """Return the camera of images of another size, (height, width, …), but of the same shape."""
    if abs(shape[0] / camera.size[0] - shape[1] / camera.size[1]) > 0.01:
        raise DatasetError(
            f"{where}: image {shape[1]}×{shape[0]}, but camera {camera.size[1]}×{camera.size[0]}; "
            "expected the same shape"
        )
    return camera.resized((shape[0], shape[1]))


def resample_for_camera(
    color: NDArray[np.uint8], own: Intrinsics, other: Intrinsics, shape: tuple[int, ...]
) -> NDArray[np.uint8]:
    """Resample an image for another camera at the same position: (h, w, 3) uint8 → (*shape, 3).

    Pixels are averaged if the image shrinks. Outside the image, its border is repeated.
    """
    factor = other.fx / own.fx
    if factor < 1:
        size = [max(1, round(pixels * factor)) for pixels in (color.shape[1], color.shape[0])]
        factor_x, factor_y = size[0] / color.shape[1], size[1] / color.shape[0]
        color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        own = Intrinsics(
            own.fx * factor_x,
            own.fy * factor_y,
            (own.cx + 0.5) * factor_x - 0.5,
            (own.cy + 0.5) * factor_y - 0.5,
        )
    x, y = own.fx / other.fx, own.fy / other.fy
    affine = np.array([[x, 0, own.cx - x * other.cx], [0, y, own.cy - y * other.cy]])
    seen: NDArray[np.uint8] = cv2.warpAffine(
        color,
        affine,
        (shape[1], shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return seen


def images(root: Path, place: str, expected: str) -> list[Path]:
    """Return the images in a folder, in the order of the numbers in their names, without hidden files."""
    return ImagesAt((place,)).files(root, expected, SUFFIXES)


def depth_images(root: Path, at: ImagesAt, expected: str) -> list[Path]:
    """Return the depth files of a recording, in order, without files named differently from most.

    Raises:
        DatasetError: the files are of several kinds.
    """
    found = at.files(root, expected, readers.DEPTH_SUFFIXES)
    kinds = sorted({path.suffix.lower() for path in found})
    if len(kinds) > 1:
        raise DatasetError(
            f"{found[0].parent} holds files of {' and '.join(kinds)}; expected depth of one kind: "
            "move the others away"
        )
    alike = max(series_of(found), key=len, default=found)
    lengths = {len(path.stem) for path in found}
    if len(lengths) == 1 or 2 * len(alike) <= len(found) or len(alike) == len(found):
        return found
    other = next(path for path in found if path not in alike)
    log.warning(
        "%s is left out%s: it is not named like the %d others", other,
        f", with {len(found) - len(alike) - 1} more" * (len(found) > len(alike) + 1), len(alike),
    )  # fmt: skip
    return alike


def _places(root: Path, place: str) -> list[Path]:
    return sorted(root.glob(place)) if "*" in place else [root / place]


def _files(where: Path, expected: str, pattern: str, suffixes: tuple[str, ...]) -> list[Path]:
    if not where.is_dir():
        raise DatasetError(f"{where} is missing; expected {expected}")
    return in_order(path for path in where.glob(pattern) if path.suffix.lower() in suffixes)


def first_size(files: Sequence[Any], read: Callable[[Any], NDArray[Any]]) -> tuple[int, int]:
    """Return (height, width) of most of a recording's first images, to find its camera."""
    sizes: list[tuple[int, int]] = []
    for index, file in enumerate(files):
        try:
            height, width = read(file).shape[:2]
        except DatasetError:
            if not sizes and (2 * index + 2 > len(files) or index >= _FIRST_TRIES):
                raise  # all images are taken as unreadable
            continue
        sizes.append((height, width))
        if len(sizes) == _SIZES:
            break
    return max(sizes, key=sizes.count)


def color_images(depth: list[Path], root: Path, at: tuple[ImagesAt, ImagesAt], expected: str) -> list[Path]:
    """Return the colour image of each depth image, by file name. Some of these files can be missing.

    Args:
        at: folders and names of depth and colour. If both are in one folder, all colour can be missing.

    Raises:
        DatasetError: most colour images are missing.
    """
    deep, colored = at
    found = colored.files(root, expected, SUFFIXES)
    if not found and colored.places == deep.places:
        return []
    by_stem = {path.stem: path for path in found}
    stems = [colored.name.format(deep.shared(image.stem)) for image in depth]
    missing = [stem for stem in stems if stem not in by_stem]
    where = colored.folder(root)
    if 2 * len(missing) > len(depth):
        raise DatasetError(
            f"{where / missing[0]}.png or .jpg is missing, but {depth[0].parent} has its depth; "
            f"expected {expected}"
        )
    suffix = found[0].suffix if found else ".png"
    return [by_stem.get(stem, where / f"{stem}{suffix}") for stem in stems]


def poses_by_number(
    names: Sequence[str], poses: Sequence[tuple[int, Transform | None]], source: Path
) -> list[Transform | None]:
    """Return the pose of each image, paired by the number in its name, or else in order.

    Poses are paired in order if they are as many as images and the numbers do not fit: some names have no
    number, or images or poses are merely counted, or a tenth of the numbers differs.
    """
    numbers, listed = [_number(name) for name in names], [number for number, _ in poses]
    are_unique = None not in numbers and len(set(listed)) == len(listed)
    found = dict(poses)
    if len(names) == len(poses):
        same = sum(number in found for number in numbers)
        are_others = _counts_on(numbers) or _counts_on(listed) or 10 * same < 9 * len(names)
        if not are_unique or (same < len(names) and are_others):
            return [pose for _, pose in sorted(poses, key=lambda one: one[0])]
    elif None in numbers:
        raise DatasetError(
            f"{source} has {len(poses)} poses for {len(names)} depth images, "
            "whose names are not frame numbers; "
            "expected as many poses as images, or images named by frame number"
        )
    elif 0 < (left := len(poses) - len(names)) <= max(1, FEW_LEFT * len(names)) and _counts_on(numbers):
        log.warning(
            "%s has %d poses for %d depth images, each with the pose of its number: %d left over. If images "
            "were lost and the others numbered anew, poses are wrong from there on", source, len(poses),
            len(names), left,
        )  # fmt: skip
    return [None if number is None else found.get(number) for number in numbers]


def _number(name: str) -> int | None:
    """Return the only number in a name if it is an integer, else None."""
    found = numbers_in(name)
    return int(found[0]) if len(found) == 1 and found[0].isdecimal() else None


def _counts_on(numbers: Sequence[int | None]) -> bool:
    """Return True if numbers are consecutive whole numbers, in any order."""
    there = [number for number in numbers if number is not None]
    return len(there) == len(numbers) == len(set(there)) == max(there) - min(there) + 1


class StereoFolder(PairedImages, FolderFrames):
    """Pairs of images with equal names, in the axes of the rectified left camera; raw images are rectified.

    Names that are decimal seconds or nanoseconds are times. Images without a partner are left out and
    counted.

    Args:
        intrinsics, baseline: pixels, metres, for rectified images; default `K.txt` and `baseline.txt`.
        calibration: for raw images; default one of `stereo_pairs.FILE_PAIRS` in the folder.
        options: those of `FolderFrames`. The folder has no poses: give `trajectory`, or `posed` False.

    Raises:
        DatasetError: there is no such folder, there are no pairs, or there is no camera.
    """

    layout, expected, sensor = "stereo folders", EXPECTED, "stereo"
    signs = (("left",), ("right",))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with images in `left/` and in `right/`."""
        return super().recognises(path) and all(images(path, side, EXPECTED) for side in _SIDES)

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        baseline: float | None = None,
        color: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(path, **options)
        size, self._with_color = first_size([left for left, _ in self._files], self._image), color
        self._pairs, self.camera = find_pairs(
            self._root, size, intrinsics=intrinsics, calibration=calibration, baseline=baseline
        )

    def _list(self, root: Path) -> tuple[list[tuple[Path, Path]], Times]:
        left, right = ({file.stem: file for file in images(root, side, EXPECTED)} for side in _SIDES)
        pairs = paired(left, right, self.skipped)
        files, times = in_time([left[name] for name in pairs], [*pairs])
        return [pairs[file.stem] for file in files], times

    def _recorded_poses(self, root: Path, files: object) -> FramePoses:
        raise NoPoses(f"{root} has no poses; expected --trajectory FILE; {SCAN}")
