# SPDX-License-Identifier: MIT
"""Reading of calibration files.

Kalibr's camchain (`cam0`, `cam1`), EuRoC's sensor.yaml, ROS camera_info (which OpenCV's calibration sample
writes too) and OpenCV's stereo files (M1 D1 M2 D2 R T, or LEFT.K … RIGHT.P as ORB-SLAM has them). YAML,
JSON and XML are parsed by OpenCV's FileStorage.
"""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.geometry.calibration import Camera, Size, StereoRig
from tsfusion.geometry.se3 import inverse, transform

EXPECTED = (
    "Kalibr's camchain.yaml, EuRoC's sensor.yaml, ROS camera_info, or OpenCV's matrices M1 D1 M2 D2 R T"
)
_MAX_TEXT, _MAX_DEPTH, _MAX_INDENTATION = 1 << 20, 64, 256  # characters, brackets or tags, spaces
Tree = dict[str, Any]


def read_camera(path: str | Path, *, size: Size | None = None) -> Camera:
    """Read the camera of a file (of a Kalibr chain: `cam0`).

    Args:
        size: (height, width) for a file without one.

    Raises:
        DatasetError: no such file, an unknown format, a missing or wrong value.
    """
    path = Path(path)
    try:
        return _camera(read_tree(path), size)[0]
    except (InvalidConfig, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _malformed([path], error) from error


def read_rig(*paths: str | Path, size: Size | None = None) -> StereoRig:
    """Read a stereo rig from one file, the left and the right camera's, or intrinsics and extrinsics.

    Raises:
        DatasetError: as `read_camera`; also when the transform between the cameras is missing.
    """
    files = [Path(path) for path in paths]
    trees = [read_tree(path) for path in files]
    try:
        return _rig(trees, size)
    except (InvalidConfig, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _malformed(files, error) from error


def rig_of_camera_info(left: Camera, right: Camera, R: Any, P: Any) -> StereoRig:
    """Make a rig of two ROS CameraInfo messages; `R` and `P` are (left, right) pairs of their `r` and `p`."""
    R_left, R_right = (np.asarray(each, dtype=np.float64).reshape(3, 3) for each in R)
    P_right = np.asarray(P[1], dtype=np.float64).reshape(3, 4)
    t = R_right.T @ (P_right[:, 3] / P_right[0, 0])
    return StereoRig(left, right, transform(R_right.T @ R_left, t))


def read_text(path: Path, content: str) -> str:
    """Read a text file, with or without a byte order mark; DatasetError says that `content` was expected."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; expected {content}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not a text file; expected {content}") from error
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error


def read_tree(path: Path) -> Tree:
    """Read a YAML, JSON or XML file as nested dictionaries and lists; numbers become floats.

    Raises:
        DatasetError: the file cannot be read or parsed.
    """
    text = read_text(path, EXPECTED)
    if _is_too_large(text):
        raise DatasetError(f"{path} is far too large or too deep for a calibration; expected {EXPECTED}")
    try:
        storage = cv2.FileStorage(_for_opencv(text), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        tree = _plain(storage.root())
    except (cv2.error, SystemError) as error:  # the second is how OpenCV's constructor fails in Python
        raise DatasetError(
            f"{path} is not YAML, JSON or XML that OpenCV can read; expected {EXPECTED}"
        ) from error
    if not isinstance(tree, dict) or not tree:
        raise DatasetError(f"{path} holds no named values; expected {EXPECTED}")
    return tree


def _is_too_large(text: str) -> bool:
    """Whether text is larger or deeper than any calibration: it could crash OpenCV's parser."""
    if len(text) > _MAX_TEXT or re.search(rf"^ {{{_MAX_INDENTATION}}}", text, re.MULTILINE):
        return True
    depth = 0
    tags = r"|<(?=[A-Za-z_])|</|/>" if text.lstrip().startswith("<") else ""
    for found in re.finditer(r"[\[{\]}]" + tags, text):
        depth += 1 if found[0] in "[{<" else -1
        if depth > _MAX_DEPTH:
            return True
    return False


def _for_opencv(text: str) -> str:
    """Adapt YAML to OpenCV, which requires a header and lists indented deeper than their name."""
    if text.lstrip().startswith(("{", "<")):
        return text
    lines = [line.rstrip() for line in text.splitlines()]
    kept = [line for line in lines if not line.startswith("%") and line not in ("---", "...")]
    return "%YAML:1.0\n---\n" + "\n".join(re.sub(r"^( *)- ", r"\1    - ", line) for line in kept) + "\n"


def _plain(node: Any) -> Any:
    if node.isMap():
        return {name: _plain(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isSeq():
        return [_plain(node.at(index)) for index in range(node.size())]
    return node.string() if node.isString() else node.real() if not node.isNone() else None


def _camera(tree: Tree, size: Size | None) -> tuple[Camera, Tree]:
    """Read the camera; also return its part of the file."""
    if isinstance(tree.get("cam0"), dict):
        tree = tree["cam0"]
    if "intrinsics" in tree:  # Kalibr and EuRoC
        if tree.get("camera_model", "pinhole") != "pinhole":
            raise InvalidConfig(f"camera_model must be pinhole, got {tree['camera_model']}")
        width, height = tree["resolution"] if "resolution" in tree else _given(size)[::-1]
        coefficients = tree.get("distortion_coeffs", tree.get("distortion_coefficients", []))
        model = tree.get("distortion_model", "none")
        return Camera.named(tree["intrinsics"], (height, width), model, coefficients), tree
    if "camera_matrix" in tree:  # ROS and OpenCV's sample
        if "image_width" in tree:
            size = int(tree["image_height"]), int(tree["image_width"])
        model = tree.get("distortion_model", "fisheye" if tree.get("fisheye_model") else "plumb_bob")
        coefficients = _numbers(tree.get("distortion_coefficients", []))
        return Camera.named(_numbers(tree["camera_matrix"]), _given(size), model, coefficients), tree
    raise InvalidConfig(f"no camera in it, only {', '.join(list(tree)[:8])}")


def _rig(trees: list[Tree], size: Size | None) -> StereoRig:
    if len(trees) == 1 and "cam1" in trees[0]:
        first, second = trees[0]["cam0"], trees[0]["cam1"]
        T = np.array(second["T_cn_cnm1"], dtype=np.float64)
        return StereoRig(_camera(first, size)[0], _camera(second, size)[0], T)
    if len(trees) == 2 and all("T_BS" in tree or "projection_matrix" in tree for tree in trees):
        (left, first), (right, second) = (_camera(tree, size) for tree in trees)
        if "T_BS" in first:
            T_body = [_numbers(tree["T_BS"]).reshape(4, 4) for tree in (first, second)]
            return StereoRig(left, right, inverse(T_body[1]) @ T_body[0])
        R, P = (
            [_numbers(tree[name]) for tree in (first, second)]
            for name in ("rectification_matrix", "projection_matrix")
        )
        return rig_of_camera_info(left, right, R, P)
    return _opencv_rig({name: value for tree in trees for name, value in tree.items()}, size)


def _opencv_rig(tree: Tree, size: Size | None) -> StereoRig:
    sides = ("LEFT.", "RIGHT.") if "LEFT.K" in tree else ("1", "2")
    if sides[0] == "LEFT.":
        names = {key: [f"{side}{key}" for side in sides] for key in "KDRP"}
        size = size or (int(tree["LEFT.height"]), int(tree["LEFT.width"]))
    else:
        matrix = next((m for m in ("M", "K", "cameraMatrix", "camera_matrix_") if f"{m}1" in tree), None)
        if matrix is None:
            raise InvalidConfig(f"no pair of cameras in it, only {', '.join(list(tree)[:8])}")
        coefficients = next(
            (d for d in ("D", "distCoeffs", "dist_coeffs_", "distortion_") if f"{d}1" in tree), "D"
        )
        names = {"K": [f"{matrix}{s}" for s in sides], "D": [f"{coefficients}{s}" for s in sides],
                 "R": ["R1", "R2"], "P": ["P1", "P2"]}  # fmt: skip
        named = next((tree[name] for name in ("imageSize", "image_size", "size") if name in tree), None)
        size = size or (None if named is None else (int(named[1]), int(named[0])))
    model = str(tree.get("distortion_model", "radtan"))
    left, right = (
        Camera.named(_numbers(tree[K]), _given(size), model, _numbers(tree.get(D, [])))
        for K, D in zip(names["K"], names["D"], strict=True)
    )
    if "R" in tree and "T" in tree:
        T = transform(_numbers(tree["R"]).reshape(3, 3), _numbers(tree["T"]))
        return StereoRig(left, right, T)
    R, P = ([_numbers(tree[name]) for name in names[key]] for key in "RP")
    return rig_of_camera_info(left, right, R, P)


def _numbers(value: Any) -> NDArray[np.float64]:
    """Flatten a list, or the `data` of a matrix."""
    return np.asarray(value["data"] if isinstance(value, dict) else value, dtype=np.float64).ravel()


def _given(size: Size | None) -> Size:
    if size is None:
        raise InvalidConfig("the file does not say the size of the images: give it as size=(height, width)")
    return size


def _malformed(paths: list[Path], error: Exception) -> DatasetError:
    files = " and ".join(map(str, paths))
    reason = f"has no {error}" if isinstance(error, KeyError) else f": {error}"
    return DatasetError(f"{files} {reason}; expected {EXPECTED}".replace(" :", ":"))
