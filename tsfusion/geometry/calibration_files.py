# SPDX-License-Identifier: MIT
"""Read calibration files of single cameras and stereo rigs.

Kalibr's camchain (`cam0`, `cam1`), EuRoC's sensor.yaml, ROS camera_info (also written by OpenCV's calibration
sample), single-camera files of Open3D, RealSense, Replica or ORB-SLAM, a matrix or `fx fy cx cy` in a text
file, and OpenCV's stereo files (M1 D1 M2 D2 R T, or LEFT.K … RIGHT.P as in ORB-SLAM). OpenCV's FileStorage
parses YAML and XML.
"""

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.geometry.calibration import MODELS, Camera, Size, StereoRig
from tsfusion.geometry.se3 import inverse, transform

EXPECTED = (
    "Kalibr's camchain.yaml, EuRoC's sensor.yaml, ROS camera_info, or OpenCV's matrices M1 D1 M2 D2 R T"
)
EXPECTED_CAMERA = (
    "Kalibr's, EuRoC's, ROS's, OpenCV's, Open3D's or RealSense's file of a camera; or in a .txt its 3×3 "
    "matrix, or fx fy cx cy"
)
# Names of the camera's section in files with more content
_PARTS = ("cam0", "cam", "camera", "camera_params", "intrinsic", "intrinsics", "depth")
_MATRICES = ("camera_matrix", "cameraMatrix", "intrinsic_matrix", "camera_intrinsics", "K", "k", "mtx")
_COEFFICIENTS = (
    "distortion_coefficients", "distortion_coeffs", "distCoeffs", "dist_coeffs", "coeffs", "distortion",
    "dist", "D", "d",
)  # fmt: skip
_NAMED_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_SIZES = (("image_width", "image_height"), ("width", "height"), ("w", "h"), ("W", "H"), ("cols", "rows"))
_ORB_SLAM = ("Camera.", "Camera1.")  # prefixes of ORB-SLAM's names
_MAX_TEXT, _MAX_DEPTH, _MAX_INDENTATION = 1 << 20, 64, 256  # characters, brackets or tags, spaces
# Names of a unit of depth, in small letters: depth_scale, png_depth_scale, DepthMapFactor, depth.units, …
_DEPTH_UNIT = re.compile(
    r"depth.*(scal(e|ing)|factor(?!y)|unit)|unitsper(meter|metre|m)$|(^|cam|camera)scale$"
)
_METRES = {"m": 1.0, "meter": 1.0, "metre": 1.0, "mm": 0.001, "millimeter": 0.001, "millimetre": 0.001}
_FINEST_UNIT, _COARSEST_UNIT = 1e-6, 0.1  # metres, of integer depth; or one metre
Tree = dict[str, Any]


def read_camera(path: str | Path, *, size: Size | None = None) -> Camera:
    """Read the camera of a file (`cam0` of a Kalibr chain); a `.txt` has a matrix, or `fx fy cx cy` and more.

    `size`: (height, width) for a file without one. Raises DatasetError for a missing file, an unknown format,
    or a missing or wrong value.
    """
    path = Path(path)
    try:
        if path.suffix.lower() in (".txt", ""):
            return _camera_in_text(read_text(path, EXPECTED_CAMERA), size)
        return _camera(read_tree(path), size)[0]
    except (InvalidConfig, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _malformed([path], error, EXPECTED_CAMERA) from error


def read_depth_unit(path: str | Path) -> float | None:
    """Return the metres per unit of integer depth in a camera's file; None if unstated or unreadable.

    A number above 1 means units per metre, whatever its name: Open3D's `depth_scale` is 1000, others' 0.001.

    Raises DatasetError for a wrong unit of depth, or several.
    """
    path, tree = Path(path), {}
    with suppress(DatasetError):
        is_text = path.suffix.lower() in (".txt", "")
        tree = _named_in_text(read_text(path, EXPECTED_CAMERA)) if is_text else read_tree(path)
    stated = {name: _metres(value) for name, value in _leaves(tree) if _is_depth_unit(name, value)}
    for name, metres in stated.items():
        if metres is None:
            raise DatasetError(
                f"{path}: {name} is no unit of depth; expected metres a unit (0.001) or units a metre (1000)"
            )
    if len({f"{metres:.4g}" for metres in stated.values()}) > 1:
        raise DatasetError(f"{path} states several units of depth: {', '.join(stated)}; leave one of them")
    return next(iter(stated.values()), None)


def _leaves(tree: Tree, above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of a file with the names of its sections: `depth.scale`."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _is_depth_unit(name: str, value: Any) -> bool:
    plain = re.sub(r"[^a-z]", "", name.lower())
    match = None if isinstance(value, bool | list) or value is None else _DEPTH_UNIT.search(plain)
    # A plain `scale` may be the scale of the images
    return match is not None and ("depth" in plain or "unit" in plain or _metres(value) not in (None, 1.0))


def _metres(value: Any) -> float | None:
    """Return metres per unit from a file's value, even if it is units per metre; None if it is neither."""
    try:
        number = _METRES.get(str(value).strip().lower().removesuffix("s")) or float(value)
    except ValueError:
        return None
    metres = 1 / number if number > 1 else number
    return metres if metres == 1 or _FINEST_UNIT <= metres <= _COARSEST_UNIT else None


def read_rig(*paths: str | Path, size: Size | None = None) -> StereoRig:
    """Read a stereo rig from one file, two camera files (left, right), or intrinsics and extrinsics.

    Raises DatasetError as `read_camera`, and for a missing transform between the cameras.
    """
    files = [Path(path) for path in paths]
    trees = [read_tree(path) for path in files]
    try:
        return _rig(trees, size)
    except (InvalidConfig, KeyError, TypeError, ValueError, OverflowError) as error:
        raise _malformed(files, error) from error


def rig_of_camera_info(left: Camera, right: Camera, R: Any, P: Any) -> StereoRig:
    """Make a rig from two ROS CameraInfo messages; `R`, `P` are (left, right) pairs of their `r`, `p`.

    `R` turns both cameras into a rectified pair; all 0 = no turn.
    """
    R_left, R_right = (np.reshape(each, (3, 3)) if np.any(each) else np.eye(3) for each in R)
    P_left, P_right = (np.asarray(each, dtype=np.float64).reshape(3, 4) for each in P)
    t = R_right.T @ (P_right[:, 3] / P_right[0, 0] - P_left[:, 3] / P_left[0, 0])
    return StereoRig(left, right, transform(R_right.T @ R_left, t))


def read_text(path: Path, content: str) -> str:
    """Read a text file, with or without a byte order mark; DatasetError says that `content` was expected."""
    try:
        limits.check(path, path.stat().st_size)
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; expected {content}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not a text file; expected {content}") from error
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error


def read_tree(path: Path) -> Tree:
    """Read a YAML, JSON or XML file as nested dictionaries and lists; numbers become floats.

    Raises DatasetError if the file cannot be read or parsed.
    """
    text = read_text(path, EXPECTED)
    if _is_too_large(text):
        raise DatasetError(f"{path} is far too large or too deep for a calibration; expected {EXPECTED}")
    tree = _json(text)
    if isinstance(tree, dict) and tree:
        return tree
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


def _json(text: str) -> Any:
    """Return the values of a JSON file; None for another file (OpenCV's YAML may look like JSON)."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _is_too_large(text: str) -> bool:
    """Return True if text is larger or deeper than any calibration: it could crash OpenCV's parser."""
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
    """Return the camera of a file, and the file's section about this camera."""
    while (part := next((name for name in _PARTS if isinstance(tree.get(name), dict)), None)) is not None:
        if "data" in tree[part] or "fx" in tree:  # a matrix of OpenCV's, or other things beside the camera
            break
        tree = tree[part]
    size = _stated_size(tree) or size
    if "intrinsics" in tree:  # Kalibr and EuRoC
        if tree.get("camera_model", "pinhole") != "pinhole":
            raise InvalidConfig(f"camera_model must be pinhole, got {tree['camera_model']}")
        model = tree.get("distortion_model", "none")
        return Camera.named(tree["intrinsics"], _given(size), model, _distortion(tree)), tree
    matrix = next((name for name in _MATRICES if name in tree), None)
    prefix = next((prefix for prefix in ("", *_ORB_SLAM) if f"{prefix}fx" in tree), None)
    if matrix is not None:  # ROS, OpenCV's sample and Open3D
        K = _matrix(tree[matrix], by_column=matrix == "intrinsic_matrix")
    elif prefix is not None:  # RealSense, Replica and ORB-SLAM
        tree = {name.removeprefix(prefix): value for name, value in tree.items()}
        cx, cy = (tree[f"pp{axis}" if f"pp{axis}" in tree else f"c{axis}"] for axis in "xy")
        fx, skew = tree["fx"], tree.get("skew", 0)
        K = np.array([fx, skew, cx, 0, tree.get("fy", fx), cy, 0, 0, 1], dtype=np.float64)
    else:
        raise InvalidConfig(f"no camera in it, only {', '.join(list(tree)[:8])}")
    coefficients = _distortion(tree)
    if any(coefficients) and "inverse" in str(tree.get("model", "")):
        raise InvalidConfig(
            f"the lens model must not be an inverse one, got {tree['model']}: give the forward one"
        )
    model = tree.get("distortion_model", "fisheye" if _is_fisheye(tree) else "plumb_bob")
    return Camera.named(K, _given(size), model if any(coefficients) else "none", coefficients), tree


def _stated_size(tree: Tree) -> Size | None:
    named = next((tree[name] for name in ("resolution", "imageSize", "image_size") if name in tree), None)
    if named is not None:
        return int(named[1]), int(named[0])
    for width, height in _SIZES:
        for prefix in ("", *_ORB_SLAM):
            if prefix + width in tree and prefix + height in tree:
                return int(tree[prefix + height]), int(tree[prefix + width])
    return None


def _matrix(value: Any, *, by_column: bool) -> NDArray[np.float64]:
    """Return the (3, 3) camera matrix of 3×3, 3×4 or 4×4 rows, or of a list (`by_column`: by columns).

    Raises InvalidConfig for another shape or form.
    """
    numbers = _numbers(value)
    if numbers.size in (12, 16):
        numbers = numbers.reshape(-1, 4)[:3, :3].ravel()
    if numbers.size != 9:
        raise InvalidConfig(f"camera matrix must be 3×3, got {numbers.size} numbers")
    K = numbers.reshape(3, 3)
    if by_column and np.ndim(value) == 1 and not K[:2, 2].any():
        K = K.T
    if K[1, 0] or np.abs(K[2] - (0, 0, 1)).max() > 1e-9:
        transposed = not K[:2, 2].any() and K[2, :2].all() and K[2, 2] == 1
        hint = ": it is transposed" if transposed else ""
        raise InvalidConfig(f"camera matrix must end with 0 0 1, got {K.tolist()}{hint}")
    return K


def _distortion(tree: Tree) -> tuple[float, ...]:
    """Return the coefficients of a lens; empty if the file has none."""
    named = next((tree[name] for name in _COEFFICIENTS if name in tree), None)
    if named is None:
        model = str(tree.get("distortion_model", ""))
        if MODELS.get(model.lower(), "pinhole") != "pinhole" and tree.keys().isdisjoint(_NAMED_COEFFICIENTS):
            raise InvalidConfig(f"distortion_model is {model}, and its coefficients are missing (is it cut?)")
        given = [float(tree.get(name, 0)) for name in _NAMED_COEFFICIENTS]
        count = 8 if any(given[5:]) else 5
        return tuple(given[: 4 if _is_fisheye(tree) else count])
    return tuple(map(float, _numbers(named)))


def _is_fisheye(tree: Tree) -> bool:
    return bool(tree.get("fisheye_model")) or "kannala" in str(tree.get("type", "")).lower()


def _camera_in_text(text: str, size: Size | None) -> Camera:
    """Read lines such as `fx: 585`, or a matrix or fx fy cx cy [k1 k2 p1 p2 [k3]] [width height]."""
    if named := _named_in_text(text):
        numbers = {name: float(word) for name, word in named.items() if not _is_depth_unit(name, word)}
        return _camera(numbers, size)[0]
    lines = (line.split("#")[0] for line in text.splitlines())
    values = _numbers(re.sub(r"[\[\],;()]", " ", " ".join(lines)).split())
    if not np.isfinite(values).all():
        raise InvalidConfig("the numbers must be finite")
    if values.size in (6, 10, 11):
        size, values = (int(values[-1]), int(values[-2])), values[:-2]
    if values.size in (12, 16) or (values.size == 9 and (values[8] == 1 or not values[[1, 3]].any())):
        return Camera.named(_matrix(values, by_column=False), _given(size), "none")
    if values.size not in (4, 8, 9):
        raise InvalidConfig(f"{values.size} numbers")
    return Camera.named(values[:4], _given(size), "plumb_bob", values[4:])


def _named_in_text(text: str) -> Tree:
    lines = (line.split("#")[0].strip() for line in text.splitlines())
    found = (re.fullmatch(r"([\w.]+)\s*[:=]\s*(\S+)", line) for line in lines)
    return {match[1]: match[2] for match in found if match}


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
    return np.asarray(value["data"] if isinstance(value, dict) else value, dtype=np.float64).ravel()


def _given(size: Size | None) -> Size:
    if size is None:
        raise InvalidConfig("the file does not say the size of the images: give it as size=(height, width)")
    return size


def _malformed(paths: list[Path], error: Exception, expected: str = EXPECTED) -> DatasetError:
    files = " and ".join(map(str, paths))
    reason = f"has no {error}" if isinstance(error, KeyError) else f": {error}"
    return DatasetError(f"{files} {reason}; expected {expected}".replace(" :", ":"))
