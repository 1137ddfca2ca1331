# SPDX-License-Identifier: MIT
"""Read captures described by a `transforms.json`: from nerfstudio, instant-ngp and compatible apps."""

from functools import partial
from math import pi, tan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, InvalidKeyframe, errors_as
from tsfusion.datasets.cameras import MILLIMETRES, DepthUnit
from tsfusion.datasets.dataset import WITHOUT_DEPTH, Times
from tsfusion.datasets.formats.image_folders import ListedFrames, Shot
from tsfusion.datasets.readers import check_metres, listed_file, read_depth, read_json
from tsfusion.geometry.calibration import Camera, Size
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.origin import FARTHEST
from tsfusion.geometry.se3 import Transform

EXPECTED = "transforms.json with fl_x, cx, … and frames of file_path, depth_file_path, transform_matrix"
_LARGEST = 1e15
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes: OpenGL's y up, z back → OpenCV's
_MODELS = {
    "PINHOLE": (), "SIMPLE_PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "SIMPLE_RADIAL": ("k1", "k2", "p1", "p2", "k3"), "RADIAL": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}  # fmt: skip


_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_OTHER_LENSES = ("ftheta", "latlong", "equirectangular", "orthographic")  # start of instant-ngp's keys


class Nerfstudio(ListedFrames):
    """Frames with depth of a nerfstudio or instant-ngp capture.

    https://docs.nerf.studio/quickstart/data_conventions.html. Poses are camera-to-world with OpenGL axes, in
    `applied_scale` units for each metre (default 1). Pixel centres are at halves. Depth is along the optical
    axis, in a 16-bit image (0 = none) or a `.npy`, named by `depth_file_path` (nerfstudio) or `depth_path`
    (instant-ngp, NeRFCapture). Distorted images are undistorted, depth by the nearest pixel. If depth has
    another size than colour, colour is resampled. No timestamps.

    Args:
        path: the folder, or the `.json` file in it.
        intrinsics, calibration: of the depth images (pixel centres at integers), instead of the file's.
        depth_scale: metres per unit; default the file's `depth_unit_scale_factor` or `integer_depth_scale`,
            else 0.001.

    Other options are those of `ListedFrames`.
    """

    layout, expected = "nerfstudio", EXPECTED
    signs = (("transforms.json",),)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with a `transforms.json`, and for a `.json` file with such a name."""
        return super().recognises(path) or (
            path.is_file() and path.suffix == ".json" and "transforms" in path.name
        )

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        path = Path(path).expanduser()
        self._file = path if path.is_file() else path / "transforms.json"
        self._capture, self.source = _read(self._file), self._file.name
        self.usual_unit = _depth_unit(self._capture, self._file)
        return super()._opened(self._file.absolute().parent, trajectory)

    def _list(self, root: Path) -> tuple[list[Shot], Times]:
        frames = self._capture["frames"]
        where = (f"{self._file}, frame {n}" for n in range(len(frames)))
        listed = map(partial(_listed_frame, self._file.parent, self._capture), frames, where)
        shots = [shot for shot in listed if shot is not None]
        if not shots:
            raise DatasetError(
                f"{self._file} has {len(frames)} frames, none with depth_file_path or depth_path; "
                "expected depth images: colour alone cannot be fused"
            )
        if len(shots) < len(frames):
            self.skipped[WITHOUT_DEPTH] = len(frames) - len(shots)
        return shots, None

    def _pose(self, shot: Shot) -> Transform:
        capture, T = self._capture, np.eye(4)
        scale = _scale(capture, "applied_scale", self._file) if "applied_scale" in capture else 1.0
        broken = ValueError, TypeError, OverflowError, InvalidKeyframe
        with errors_as(DatasetError, f"{shot}: transform_matrix", *broken):
            matrix = np.array(shot.matrix, dtype=np.float64)
            T[: len(matrix)] = matrix
            T[:3, 3] /= scale
            return check_pose(T @ OPENGL, farthest=FARTHEST)

    def _lens(self, shot: Shot, size: Size) -> Camera:
        camera, own = shot.lens
        return _camera(camera, shot.where, own or size)

    def _stored(self, file: Shot) -> NDArray[Any]:
        return read_depth(file.depth)

    def _checked_depth(self, file: Any) -> NDArray[Any]:
        """Return depth; floats, and arrays of integers, are multiplied by the unit."""
        depth = self._stored(file)
        if depth.dtype == np.uint16 and file.depth.suffix != ".npy":
            return depth
        depth = np.asarray(depth.astype(np.float32) * np.float32(self.depth_scale))
        check_metres(depth, file.depth)
        return depth


def _read(path: Path) -> dict[str, Any]:
    capture = read_json(path, EXPECTED)
    frames = capture.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise DatasetError(f"{path} has no list of frames; expected {EXPECTED}")
    return capture


def _listed_frame(root: Path, capture: dict[str, Any], frame: dict[str, Any], where: str) -> Shot | None:
    camera = {**capture, **frame}
    depth = frame.get("depth_file_path") or frame.get("depth_path")
    if not depth:
        return None
    size = None
    if "w" in camera and "h" in camera:
        size = (int(_number(camera, "h", where)), int(_number(camera, "w", where)))
    file = frame.get("file_path")
    color_file = _image(listed_file(root, str(file))) if file else None
    matrix = frame.get("transform_matrix")
    return Shot(listed_file(root, str(depth)), color_file, lens=(camera, size), matrix=matrix, where=where)


def _image(path: Path) -> Path:
    """Return the path of an image with its suffix, which Blender's captures leave out."""
    return path if path.suffix or not path.with_suffix(".png").exists() else path.with_suffix(".png")


def _camera(given: dict[str, Any], where: str, size: Size) -> Camera:
    """Return the camera described by a frame's keys, for images of (height, width) `size`."""
    model = str(given.get("camera_model", "OPENCV"))
    other = next((key for key in given if key.startswith(_OTHER_LENSES) and given[key]), None)
    if model not in _MODELS or other is not None:
        got = repr(model) if other is None else other
        raise DatasetError(f"{where}: camera_model must be one of {', '.join(_MODELS)}, got {got}")
    if given.get("is_fisheye"):  # instant-ngp's
        model = "OPENCV_FISHEYE"
    bent = [key for key in _COEFFICIENTS if key in given and _number(given, key, where)]
    if bent and not _MODELS[model]:  # nerfstudio applies them with any model
        model = "OPENCV"
    if unused := [key for key in bent if key not in _MODELS[model]]:
        raise DatasetError(f"{where}: {unused[0]} is not 0, but the lens model {model} has none")
    fx = _focal_length(given, "x", size[1], where)
    if fx is None:
        raise DatasetError(f"{where} has neither fl_x nor camera_angle_x; expected {EXPECTED}")
    fy = _focal_length(given, "y", size[0], where) or fx
    cx = _number(given, "cx", where) if "cx" in given else size[1] / 2
    cy = _number(given, "cy", where) if "cy" in given else size[0] / 2
    distortion = [_number(given, key, where) if key in given else 0.0 for key in _MODELS[model]]
    kind = "fisheye" if model == "OPENCV_FISHEYE" else "radtan" if distortion else "pinhole"
    with errors_as(DatasetError, where, InvalidConfig):
        skew = _number(given, "skew", where) if "skew" in given else 0.0
        return Camera.named((fx, fy, cx - 0.5, cy - 0.5), (size[0], size[1]), kind, distortion, skew)


def _focal_length(given: dict[str, Any], axis: str, side: int, where: str) -> float | None:
    """Return the focal length, pixels, as given or from the angle of view of `side` pixels; None without."""
    if f"fl_{axis}" in given:
        return _number(given, f"fl_{axis}", where)
    name = f"camera_angle_{axis}"
    if name not in given:
        return None
    angle = _number(given, name, where)
    if not 0 < angle < pi:
        raise DatasetError(f"{where}: {name} must be radians between 0 and pi, got {angle}")
    return side / 2 / tan(angle / 2)


def _number(given: dict[str, Any], key: str, where: str) -> float:
    value = given[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        raise DatasetError(f"{where}: {key} must be a number, got {value!r}")
    return float(value)


def _depth_unit(capture: dict[str, Any], file: Path) -> DepthUnit:
    for key in ("depth_unit_scale_factor", "integer_depth_scale"):
        if key in capture:
            return DepthUnit(_scale(capture, key, file), f"from {file.name}")
    return MILLIMETRES


def _scale(capture: dict[str, Any], key: str, file: Path) -> float:
    scale = _number(capture, key, str(file))
    if scale <= 0:
        raise DatasetError(f"{file}: {key} must be > 0, got {scale}")
    return scale
