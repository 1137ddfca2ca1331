# SPDX-License-Identifier: MIT
"""Find the camera of a recording's depth images: given by the user, from a file, or published.

These are tried in this order, and nothing is guessed. The camera published by a benchmark is used only for
the benchmark's own recordings (known by their names), and only at its own image size.
"""

import os
import re
from collections.abc import Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, errors_as
from tsfusion.datasets.dataset import Dataset, first_frame
from tsfusion.datasets.readers import checked_intrinsics
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.calibration_files import read_camera, read_depth_unit
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics

FILES = (
    "camera-intrinsics.txt, K.txt, intrinsics.txt, camera_intrinsic.json, camera.yaml, camera_info.yaml or "
    "calibration.yaml"
)
GIVE = "give --intrinsics fx,fy,cx,cy or --calibration FILE"
# File names in small letters, without separators
_FILE = re.compile(
    r"(?P<before>depth|colou?r|rgb)?(k|intrinsics?(matrix)?|calib(ration)?"
    r"|cam(era)?0?(intrinsics?|matrix|info|param(eter)?s?|calib(ration)?|primesense)?)(?P<after>depth|colou?r|rgb)?"
    r"\.(txt|json|ya?ml|xml)|(ost|sensor|camchain.*)\.ya?ml"
)
_EQUAL_PX, _EQUAL_SHARE = 0.5, 2e-3  # allowed difference of two files of one camera: pixels, plus a share


class UnknownCamera(DatasetError):
    """The camera of a recording is not known from any source."""


@dataclass(frozen=True)
class PublishedCamera:
    """Camera that a benchmark publishes for its recordings."""

    name: str  # name of the benchmark
    intrinsics: Intrinsics
    size: Size = (480, 640)
    distortion: tuple[float, ...] = ()  # of the lens (`Camera`, radtan)

    @property
    def lens(self) -> Camera:
        return Camera(self.intrinsics, self.size, "radtan" if self.distortion else "pinhole", self.distortion)


@dataclass(frozen=True)
class DepthUnit:
    """Unit of a recording's integer depth, and the source that states it; `str` shows both."""

    metres: float
    source: str
    is_stated: bool = True  # False = usual for the layout

    def __str__(self) -> str:
        return f"depth unit {1000 * self.metres:.4g} mm ({1 / self.metres:.6g} a metre), {self.source}"


MILLIMETRES = DepthUnit(0.001, "as usual", is_stated=False)


@dataclass(frozen=True, eq=False)
class RecordedCamera:
    """Pinhole camera of a recording's depth images, and the source that states it; `str` shows both."""

    intrinsics: Intrinsics  # of the images after `depth` and `color`
    size: Size  # (height, width) of the depth images
    source: str
    undistorter: Undistorter | None = None
    stated_unit: DepthUnit | None = None  # of depth, stated by a camera file

    def __str__(self) -> str:
        undistorted = "" if self.undistorter is None else ", undistorted"
        if self.lens.skew:
            undistorted += f" (skew {self.lens.skew:.4g} px)"
        return f"{described(self.intrinsics, self.size)}, {self.source}{undistorted}"

    @property
    def lens(self) -> Camera:
        """Camera model of the images as recorded, with the distortion that `depth` and `color` remove."""
        return Camera(self.intrinsics, self.size) if self.undistorter is None else self.undistorter.camera

    def depth_unit(self, given: float | None, usual: DepthUnit = MILLIMETRES) -> DepthUnit:
        """Return the unit of depth: as given (metres), else as stated by a file, else the usual one."""
        return self.stated_unit or usual if given is None else DepthUnit(given, "as given")

    def depth(self, depth: NDArray[Any]) -> NDArray[Any]:
        """Remove the distortion from depth, by the nearest pixel; 0 where the camera did not see."""
        return depth if self.undistorter is None else self.undistorter.depth(depth)

    def color(self, color: NDArray[Any]) -> NDArray[Any]:
        """Remove the distortion from a colour image, whose pixels are those of the depth image."""
        return color if self.undistorter is None else self.undistorter.image(color)


def described(intrinsics: Intrinsics, size: Sequence[int]) -> str:
    """Return intrinsics and image size as text, such as `fx 585 fy 585 cx 320 cy 240, 640×480`."""
    numbers = " ".join(f"{name} {getattr(intrinsics, name):.6g}" for name in ("fx", "fy", "cx", "cy"))
    return f"{numbers}, {size[1]}×{size[0]}"


def camera_line(dataset: Dataset, first: Frame | None = None) -> str:
    """Describe a dataset's camera in one line, as the dataset or its first frame states it; empty without."""
    if own := recorded_camera(dataset):
        return own
    first = first_frame(dataset) if first is None else first
    return "" if first.intrinsics is None else f"{described(first.intrinsics, first.shape)}, from its frames"


def recorded_camera(dataset: Dataset) -> str:
    """Describe the camera that a recording states, and a separate colour camera if one was found; or ""."""
    camera, place = getattr(dataset, "camera", None), getattr(dataset, "color_place", None)
    return f"{camera}" + f"; {place}" * bool(place) if isinstance(camera, RecordedCamera) else ""


def depth_line(dataset: Dataset, first: Frame) -> str:
    """Describe the unit of a dataset's depth images and its source; empty without a unit."""
    if first.depth is None:
        return ""
    unit = getattr(dataset, "depth_unit", None) or DepthUnit(first.depth_scale, "from its frames")
    along = ", measured along each pixel's ray" * getattr(dataset, "along_ray", False)
    return ("depth in metres" if first.depth.dtype == np.float32 else str(unit)) + along


def find_camera(
    root: Path,
    size: Sequence[int],
    *,
    intrinsics: Intrinsics | None = None,
    calibration: str | Path | None = None,
    places: Sequence[Path] = (),
    files: Iterable[Path] = (),
    published: PublishedCamera | None = None,
) -> RecordedCamera:
    """Find the camera of a recording's depth images.

    A calibration for images of another size is scaled if their aspect ratio is the same.

    Args:
        root: the recording's folder.
        size: (height, width) of the depth images.
        intrinsics: used before everything else.
        calibration: camera file, used before files of the recording.
        places: folders with camera files; the first folder that has some is used; default `root`.
        files: the layout's own camera files, used before files in `places`.
        published: the benchmark's camera, if this is a recording of the benchmark.

    Raises:
        DatasetError: there is no camera, two cameras contradict each other, or the image size differs.
    """
    height_width = int(size[0]), int(size[1])
    given = given_camera(height_width, intrinsics=intrinsics, calibration=calibration)
    own = [*files]
    with nullcontext() if given is None else suppress(DatasetError):
        own = own or next(filter(None, (camera_files(place) for place in places or (root,))), [])
    if given is not None and given.stated_unit is not None:
        return given
    recorded = given or _consistent(own, height_width, root)
    if recorded is not None:
        return replace(recorded, stated_unit=_stated_unit(own, root))
    if published is not None and published.size == height_width:
        return _fitted(published.lens, height_width, root, f"published for {published.name}")
    raise UnknownCamera(_unknown(root, height_width, published))


def given_camera(
    size: Size, *, intrinsics: Intrinsics | None, calibration: str | Path | None
) -> RecordedCamera | None:
    """Return the camera given by the user, or None if none was given. Raises as `find_camera`."""
    if intrinsics is not None and calibration is not None:
        raise DatasetError("intrinsics and calibration exclude each other: give one of them")
    if intrinsics is not None:
        checked = checked_intrinsics(intrinsics, "intrinsics")
        _check_centre(checked, size, "intrinsics")
        return RecordedCamera(checked, size, "as given")
    if calibration is None:
        return None
    path = Path(calibration).expanduser()
    fitted = _fitted(read_camera(path, size=size), size, path, f"from the given {path.name}")
    return replace(fitted, stated_unit=_stated_unit([path], path.parent))


def camera_files(place: Path) -> list[Path]:
    """Return the camera files of a folder, known by their names. Files for a depth camera are preferred.

    Raises:
        DatasetError: there is only a file of the colour camera.
    """
    named: dict[str, list[Path]] = {"depth": [], "": [], "color": []}
    for path in sorted(place.iterdir()) if place.is_dir() else []:
        match = _FILE.fullmatch((re.sub(r"[-_. ]", "", path.stem) + path.suffix).lower())
        if match is not None and not path.name.startswith(".") and path.is_file():
            of = match["before"] or match["after"] or ""
            named[of if of in ("depth", "") else "color"].append(path)
    if named["color"] and not named["depth"] and not named[""]:
        raise DatasetError(
            f"{named['color'][0]} is of the colour camera, and the depth camera has no file; if depth is "
            f"registered to colour give --calibration {named['color'][0]}, else the depth camera's "
            "--intrinsics fx,fy,cx,cy"
        )
    return named["depth"] or named[""]


def _consistent(files: Sequence[Path], size: Size, root: Path) -> RecordedCamera | None:
    """Return the one camera that several files describe, by preference from a file with lens distortion."""
    cameras = [(path, read_camera(path, size=size)) for path in files]
    fitted = [_fitted(camera, size, path, f"from {os.path.relpath(path, root)}") for path, camera in cameras]
    for (path, camera), other in zip(cameras[1:], cameras, strict=False):
        if not _agree(camera, other[1], size):
            pair = (other, (path, camera))
            both = "; ".join(f"{file} says {described(each.intrinsics, each.size)}" for file, each in pair)
            raise DatasetError(f"two cameras contradict each other: {both}; remove one file, or {GIVE}")
    return next((one for one in fitted if one.undistorter is not None), fitted[0] if fitted else None)


def _stated_unit(files: Sequence[Path], root: Path) -> DepthUnit | None:
    """Return the unit of depth stated by camera files. Raises DatasetError if two contradict each other."""
    stated = [(metres, path) for path in files if (metres := read_depth_unit(path)) is not None]
    if not stated:
        return None
    metres, path = stated[0]
    if other := next((each for each in stated if abs(each[0] / metres - 1) > _EQUAL_SHARE), None):
        raise DatasetError(
            f"two units of depth contradict each other: {metres:.4g} m of {path}, {other[0]:.4g} m of "
            f"{other[1]}; remove one, or give --option depth_scale=METRES"
        )
    return DepthUnit(metres, f"from {os.path.relpath(path, root)}")


def _agree(one: Camera, other: Camera, size: Size) -> bool:
    a, b = (
        np.array([each.skew * size[1] / each.size[1], K.fx, K.fy, K.cx, K.cy])
        for each in (one, other)
        for K in (each.intrinsics.scaled(size[1] / each.size[1]),)
    )
    lenses = one.distortion == other.distortion or not one.distortion or not other.distortion
    return lenses and bool((abs(a - b) <= _EQUAL_PX + _EQUAL_SHARE * abs(a)).all())


def _fitted(camera: Camera, size: Size, path: Path, source: str) -> RecordedCamera:
    """Return a file's camera for images of this size, scaled if the aspect ratio is the same."""
    if camera.size != size:
        if camera.size[0] * size[1] != camera.size[1] * size[0]:
            raise DatasetError(
                f"{path} is the camera of images of {_shape(camera.size)}, but these are {_shape(size)}, of "
                f"another aspect ratio; {GIVE} of these images"
            )
        source += f" scaled from {_shape(camera.size)}"
        camera = camera.resized(size)
    _check_centre(camera.intrinsics, size, path)
    if camera.is_pinhole:
        return RecordedCamera(camera.intrinsics, size, source)
    with errors_as(DatasetError, path, InvalidConfig):
        undistorter = Undistorter(camera)
    return RecordedCamera(undistorter.intrinsics, size, source, undistorter)


def _check_centre(intrinsics: Intrinsics, size: Size, source: object) -> None:
    """Raise DatasetError if the principal point is outside the images: the camera is of other images."""
    for name, side in (("cx", size[1]), ("cy", size[0])):
        value = getattr(intrinsics, name)
        if not -0.5 < value < side - 0.5:
            raise DatasetError(
                f"{source}: {name} {value:.6g} lies outside of the images, which are {_shape(size)}; "
                "expected fx fy cx cy in pixels of these images (of another size, or in another order?)"
            )


def _unknown(root: Path, size: Size, published: PublishedCamera | None) -> str:
    known = ""
    if published is not None:
        known = f" (that of {published.name} is published for {_shape(published.size)} alone)"
    return f"{root}: the camera of these {_shape(size)} images is not known{known}: no {FILES}; {GIVE}"


def _shape(size: Size) -> str:
    return f"{size[1]}×{size[0]}"
