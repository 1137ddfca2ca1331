# SPDX-License-Identifier: MIT
"""Check and hold keyframes: measurements of any sensor with a pose; compute their points."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal, TypedDict, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import config
from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import object_cards, sweeps
from tsfusion.geometry.origin import FAR

_T = TypeVar("_T")
Kind = Literal["depth", "disparity", "points"]

MAX_IMAGE_SIDE = 8192
MAX_POINTS = 2_000_000
MAX_BASELINE_M = 5.0  # of a stereo camera; a larger number must be millimetres
MAX_TRANSLATION = 1e6
MAX_SENSOR_NAME = 32
_LEAST = np.finfo(np.float64).tiny  # LAPACK fails on smaller numbers if a library makes the CPU flush them
_ROTATION_TOLERANCE = 1e-3
_ROTATION_EXACT = 1e-9


class Intrinsics(msgspec.Struct, frozen=True, array_like=True):
    """Pinhole intrinsics in pixels: `u = fx·x/z + cx`, `v = fy·y/z + cy`.

    `fx > 0`; `fy` may be negative (an image stored bottom-up, as in ICL-NUIM).

    Examples:
        >>> camera = tsfusion.Intrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5)
        >>> camera.scaled(0.5)
        Intrinsics(fx=262.5, fy=262.5, cx=159.5, cy=119.5)
    """

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Camera matrix K, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def ray_lengths(self, shape: Sequence[int]) -> NDArray[np.float32]:
        """Return each pixel's ray length for depth 1 along the axis: (H, W) float32, of `shape`."""
        x = (np.arange(shape[1]) - self.cx) / self.fx
        y = (np.arange(shape[0]) - self.cy) / self.fy
        return np.sqrt(1 + x**2 + y[:, None] ** 2).astype(np.float32)

    def scaled(self, factor: float) -> "Intrinsics":
        """Return the intrinsics of the image resized by `factor` (pixel centres at integers)."""
        return Intrinsics(
            self.fx * factor, self.fy * factor, (self.cx + 0.5) * factor - 0.5, (self.cy + 0.5) * factor - 0.5
        )


def _explains_names(cls: type[_T]) -> type[_T]:
    """Make a class's error about a wrong field name suggest the right name (a decorator)."""
    made = cls.__init__

    @functools.wraps(made)
    def checked(self: _T, *values: Any, **given: Any) -> None:
        known = cls.__dataclass_fields__  # type: ignore[attr-defined]
        for name in [name for name in given if name not in known]:
            hint = config.instead(name, config.OTHER_NAMES_OF_KEYFRAME, known)
            raise InvalidKeyframe(f"a keyframe has no {name}{hint}")
        if values:
            raise InvalidKeyframe(
                "a keyframe's fields are given by name: Keyframe(depth=…, intrinsics=…, T_world_camera=…)"
            )
        made(self, **given)

    cls.__init__ = checked  # type: ignore[method-assign, assignment]
    return cls


@_explains_names
@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Keyframe(object_cards.Shown):
    """One measurement with a pose. Give exactly one of `depth`, `disparity` and `points`.

    Arrays are read, never written; they are made contiguous and native, and float64 points become float32
    (0.01 mm at 100 m). Pixels or points without a return are not errors: depth 0, NaN or negative,
    disparity 0, a point with a non-finite coordinate.

    Attributes:
        T_world_camera: (4, 4) float64, `p_world = T_world_camera @ p_camera`; OpenCV camera axes
            (x right, y down, z forward). For `points` it is the pose of the sensor frame.
        depth: (H, W) uint16 in units of `depth_scale` metres, or (H, W) float32 metres; z, not ray length.
        depth_scale: metres per unit of a uint16 depth image.
        disparity: (H, W) uint16; `depth = baseline_fx / (disparity · disparity_scale)`.
        disparity_scale: pixels per unit of disparity (OpenCV's SGBM: 1/16).
        baseline_fx: stereo baseline times fx, metre · pixels. Also allowed with `depth` from a stereo
            camera, where it drives the noise model.
        points: (N, 3) float32 metres in the sensor frame.
        point_times_s: (N,) seconds of each point after `timestamp_ns`, for a sensor that moves while it
            measures; each point is in the sensor frame of its own time. Without `motion` the times are
            not used, and a `Client` says so.
        motion: `(times_s, poses)` of the sensor while it measures: (k,) seconds after `timestamp_ns`,
            rising, and (k, 4, 4) in the sensor frame at `timestamp_ns`
            (`np.linalg.inv(T_world_camera) @ T_world_then`). The keyframe uses both to move its points
            into the frame at `timestamp_ns`, and then sets both to None.
        origins: start of each ray, in the sensor frame: (3,) or (N, 3) float32 metres; default the
            frame's origin. For scanners whose rays do not meet in one point.
        color: (H, W, 3) uint8 BGR, registered to the depth image, or (N, 3) uint8 BGR for points.
        confidence: (H, W) or (N,) uint8; 255 = full weight, 0 = do not use.
        intrinsics: pinhole camera, or its (3, 3) matrix; required for depth and disparity.
        sensor: name of the sensor model that sets noise and support (`kinect`, `stereo`, `lidar`, …);
            None = the volume's own.
        timestamp_ns: the sensor's clock.
        captured_ns: `time.monotonic_ns()` of the scanner at capture; 0 = unknown. Starts the delay clock.

    Raises:
        InvalidKeyframe: naming the field, its value and what was expected.

    Examples:
        >>> camera = tsfusion.Intrinsics(525.0, 525.0, 319.5, 239.5)
        >>> wall = np.full((480, 640), 1500, np.uint16)  # millimetres
        >>> tsfusion.Keyframe(depth=wall, intrinsics=camera, T_world_camera=np.eye(4)).kind
        'depth'
        >>> scan = np.zeros((1000, 3), np.float32)
        >>> tsfusion.Keyframe(points=scan, T_world_camera=np.eye(4), sensor="lidar").shape
        (1000,)
    """

    T_world_camera: NDArray[np.float64]
    depth: NDArray[Any] | None = None
    depth_scale: float = 0.001
    disparity: NDArray[np.uint16] | None = None
    disparity_scale: float = 1 / 16
    baseline_fx: float | None = None
    points: NDArray[np.float32] | None = None
    point_times_s: NDArray[np.float32] | None = None
    motion: sweeps.Motion | None = None
    origins: NDArray[np.float32] | None = None
    color: NDArray[np.uint8] | None = None
    confidence: NDArray[np.uint8] | None = None
    intrinsics: Intrinsics | None = None
    sensor: str | None = None
    timestamp_ns: int = 0
    captured_ns: int = 0
    kind: Kind = field(init=False)

    def __post_init__(self) -> None:
        put = object.__setattr__  # the dataclass is frozen for everyone else
        put(self, "kind", self._one_measurement())
        put(self, "T_world_camera", check_pose(self.T_world_camera))
        getattr(self, f"_check_{self.kind}")()
        if self.color is not None:
            put(self, "color", _array("color", self.color, (np.uint8,), (*self.shape, 3)))
        if self.confidence is not None:
            put(self, "confidence", _array("confidence", self.confidence, (np.uint8,), self.shape))
        if self.sensor is not None and not (
            isinstance(self.sensor, str) and 0 < len(self.sensor) <= MAX_SENSOR_NAME
        ):
            raise InvalidKeyframe(
                f"sensor must be a name of 1 to {MAX_SENSOR_NAME} characters, got {self.sensor!r}"
            )
        if self.baseline_fx is not None:
            put(self, "baseline_fx", _positive("baseline_fx", self.baseline_fx))
        for name in ("timestamp_ns", "captured_ns"):
            stamp = getattr(self, name)
            if not isinstance(stamp, (int, np.integer)) or not 0 <= stamp < 2**63:
                raise InvalidKeyframe(f"{name} must be an integer of nanoseconds in [0, 2^63), got {stamp!r}")
            put(self, name, int(stamp))

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Shape of the measurement: (H, W) of images, (N,) of points."""
        if self.points is not None:
            return (len(self.points),)
        return tuple(self.measurement.shape)

    def _facts(self) -> dict[str, str]:
        x, y, z = self.T_world_camera[:3, 3]
        what = f"{self.kind} {' × '.join(map(str, self.shape))} {self.measurement.dtype}"
        return {
            "measured": what + (" with colour" if self.color is not None else ""),
            "sensor": f"sensor {self.sensor or 'as of the map'}",
            "place": f"at ({x:.2f}, {y:.2f}, {z:.2f}) m",
        }

    def _pictures(self) -> list[object_cards.Picture | None]:
        return object_cards.measured(self)

    @property
    def measurement(self) -> NDArray[Any]:
        """The given array: depth, disparity or points."""
        for array in (self.depth, self.disparity, self.points):
            if array is not None:
                return array
        raise AssertionError("checked at construction")

    def _one_measurement(self) -> Kind:
        kinds: tuple[Kind, ...] = ("depth", "disparity", "points")
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) != 1:
            got = " and ".join(given) or "none"
            raise InvalidKeyframe(f"exactly one of depth, disparity and points must be given, got {got}")
        return given[0]

    def _check_depth(self) -> None:
        depth = _array("depth", self.depth, (np.uint16, np.float32), (None, None))
        object.__setattr__(self, "depth", depth)
        object.__setattr__(self, "depth_scale", _positive("depth_scale", self.depth_scale))
        if self.depth_scale > 1:
            raise InvalidKeyframe(
                f"depth_scale must be metres per unit (0.001 of millimetres), at most 1, got "
                f"{self.depth_scale:g}; for units per metre, as in Open3D, write 1/{self.depth_scale:g}"
            )
        self._check_camera()

    def _check_disparity(self) -> None:
        disparity = _array("disparity", self.disparity, (np.uint16,), (None, None))
        object.__setattr__(self, "disparity", disparity)
        object.__setattr__(self, "disparity_scale", _positive("disparity_scale", self.disparity_scale))
        if self.baseline_fx is None:
            raise InvalidKeyframe(
                "baseline_fx must be given with disparity (baseline in metres × fx in pixels)"
            )
        self._check_camera()

    def _check_points(self) -> None:
        if self.intrinsics is not None:
            raise InvalidKeyframe(f"intrinsics go with images, not with points; got {self.intrinsics!r}")
        points = _single("points", self.points, (None, 3))
        object.__setattr__(self, "points", points)
        if len(points) > MAX_POINTS:
            raise InvalidKeyframe(f"points must be at most {MAX_POINTS}, got {len(points)}: cut the cloud")
        if are_far(points):
            raise InvalidKeyframe(
                f"all points are more than {FAR / 1000:g} km from the sensor, as in a grid: give them in the "
                "sensor's frame, and its pose in the grid as T_world_camera (for files: --trajectory)"
            )
        if self.origins is not None:
            one = np.ndim(self.origins) == 1
            shape = (3,) if one else (len(points), 3)
            origins = _single("origins", self.origins, shape)
            if not np.isfinite(origins).all():
                raise InvalidKeyframe("origins must be finite, got NaN or infinity")
            object.__setattr__(self, "origins", origins)
        if self.point_times_s is not None:
            times = _single("point_times_s", self.point_times_s, (len(points),))
            if not np.isfinite(times).all():
                raise InvalidKeyframe("point_times_s must be finite, got NaN or infinity")
            object.__setattr__(self, "point_times_s", times)
            if self.motion is not None:
                self._put_at_stamp(times, self.motion)

    def _put_at_stamp(self, point_times_s: NDArray[np.float32], given: Any) -> None:
        kinds = np.float32, np.float64
        try:
            times_s, poses = given
        except (TypeError, ValueError) as error:
            raise InvalidKeyframe(f"motion must be (times_s, poses), got {given!r}") from error
        times = _array("motion's times_s", times_s, kinds, (None,))
        motion = sweeps.Motion(times, _array("motion's poses", poses, kinds, (len(times), 4, 4)))
        no_return = ~np.any(self.points, axis=1)
        for name in ("points", "origins"):
            if (array := getattr(self, name)) is not None:
                array = np.broadcast_to(array, (len(point_times_s), 3))
                object.__setattr__(self, name, sweeps.at_stamp(array, point_times_s, motion))
        self.measurement[no_return] = np.nan  # drivers write 0, 0, 0, which must not become a point
        object.__setattr__(self, "point_times_s", None)
        object.__setattr__(self, "motion", None)

    def _check_camera(self) -> None:
        if self.origins is not None:
            raise InvalidKeyframe("origins go with points only: the rays of an image start at the camera")
        if self.point_times_s is not None:
            raise InvalidKeyframe("point_times_s go with points only")
        if max(self.shape) > MAX_IMAGE_SIDE:
            raise InvalidKeyframe(
                f"{self.kind} must be at most {MAX_IMAGE_SIDE} pixels a side, got {self.shape}"
            )
        intrinsics = intrinsics_of(self.intrinsics)
        if intrinsics is None:
            raise InvalidKeyframe(
                f"intrinsics must be given with {self.kind} as Intrinsics(fx, fy, cx, cy), or as the matrix "
                f"[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {' '.join(repr(self.intrinsics).split())}"
            )
        object.__setattr__(self, "intrinsics", check_intrinsics(intrinsics))


class KeyframeFields(TypedDict, total=False):
    """Names and types of the fields of a `Keyframe`, for type checkers."""

    T_world_camera: NDArray[np.float64]
    depth: NDArray[Any] | None
    depth_scale: float
    disparity: NDArray[np.uint16] | None
    disparity_scale: float
    baseline_fx: float | None
    points: NDArray[np.float32] | None
    point_times_s: NDArray[np.float32] | None
    motion: sweeps.Motion | None
    origins: NDArray[np.float32] | None
    color: NDArray[np.uint8] | None
    confidence: NDArray[np.uint8] | None
    intrinsics: Intrinsics | None
    sensor: str | None
    timestamp_ns: int
    captured_ns: int


def keyframe_of(value: Any) -> Keyframe:
    """Return a keyframe from itself or from a mapping or object of its fields. Raises InvalidKeyframe."""
    if isinstance(value, Keyframe):
        return value
    if isinstance(value, Mapping):
        return Keyframe(**value)
    if not hasattr(value, "T_world_camera"):
        raise InvalidKeyframe(
            f"expected a Keyframe, a dict of its fields or an object with such attributes, got "
            f"{', '.join(type(one).__name__ for one in (value if isinstance(value, tuple) else (value,)))}; "
            "by name: depth=…, intrinsics=…, T_world_camera=… (np.linalg.inv of Open3D's extrinsic), or "
            "points=… in the sensor's frame (VDBFusion's are in the world's), T_world_camera=…"
        )
    names = [each.name for each in fields(Keyframe) if each.init and hasattr(value, each.name)]
    return Keyframe(**{name: getattr(value, name) for name in names})


def intrinsics_of(value: Any) -> Intrinsics | None:
    """Convert intrinsics, a camera matrix or four numbers to Intrinsics; return None for any other value."""
    if isinstance(value, Intrinsics) or value is None:
        return value
    try:
        numbers = np.asarray(getattr(value, "intrinsic_matrix", value), dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if numbers.shape == (4,):
        return Intrinsics(*numbers.tolist())
    if numbers.shape != (3, 3) or (numbers.flat[[1, 3, 6, 7]] != 0).any() or numbers[2, 2] != 1:
        return None
    return Intrinsics(*numbers.flat[[0, 4, 2, 5]].tolist())


def check_intrinsics(intrinsics: Intrinsics) -> Intrinsics:
    """Convert to Python floats; raise InvalidKeyframe unless finite, `fx > 0` and `fy != 0`."""
    try:
        fx, fy, cx, cy = map(float, msgspec.structs.astuple(intrinsics))
    except (TypeError, ValueError) as error:
        raise InvalidKeyframe(f"intrinsics must be four numbers, got {intrinsics}") from error
    if not np.isfinite([fx, fy, cx, cy]).all() or fx <= 0 or fy == 0:
        raise InvalidKeyframe(f"intrinsics must be finite with fx > 0 and fy != 0, got {intrinsics}")
    return Intrinsics(fx, fy, cx, cy)


def check_pose(pose: Any, *, farthest: float = MAX_TRANSLATION) -> NDArray[np.float64]:
    """Check a rigid transform; return it as (4, 4) float64, with a rotation within 1e-3 made exact.

    A second check changes no bit, so a keyframe checked at both ends of a wire gives the same map.
    """
    try:
        T = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidKeyframe(f"T_world_camera must be a (4, 4) matrix of numbers, got {pose!r}") from error
    if T.shape != (4, 4):
        raise InvalidKeyframe(f"T_world_camera must have shape (4, 4), got {T.shape}")
    if not np.isfinite(T).all():
        raise InvalidKeyframe(f"T_world_camera must be finite, got {T.tolist()}")
    R, t = T[:3, :3], T[:3, 3]
    if np.abs(R).max() > 2:  # so far off that RᵀR could overflow
        raise InvalidKeyframe(f"T_world_camera must hold a rotation, got entries up to {np.abs(R).max():.3g}")
    deviation = float(np.abs(R.T @ R - np.eye(3)).max())
    with np.errstate(divide="ignore"):  # entries too small to divide by
        det = float(np.linalg.det(R))
    if deviation > _ROTATION_TOLERANCE or det <= 0:
        raise InvalidKeyframe(
            f"T_world_camera must hold a rotation (RᵀR = I within {_ROTATION_TOLERANCE}, det > 0), "
            f"got |RᵀR - I| = {deviation:.3g}, det = {det:.3g}"
        )
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise InvalidKeyframe(f"T_world_camera must end with the row 0 0 0 1, got {T[3].tolist()}")
    if np.abs(t).max() > farthest:
        raise InvalidKeyframe(
            f"T_world_camera must translate by at most {farthest:.0e} m, got {t.tolist()}: "
            "subtract an origin from positions in a national grid or UTM (--origin X,Y,Z)"
        )
    if deviation > _ROTATION_EXACT:
        T[:3, :3] = _nearest_rotation(R)
    T[3] = (0, 0, 0, 1)
    return T


def are_far(points: NDArray[np.floating]) -> bool:
    """Return True if all valid (n, 3) points are beyond `FAR` along an axis; False without points."""
    if not len(points) or np.abs(points[0]).max() <= FAR:
        return False
    away = np.abs(points).max(axis=1)
    away = away[np.isfinite(away)]
    return bool(len(away) and away.min() > FAR)


def _nearest_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    try:
        U, _, Vt = np.linalg.svd(np.where(np.abs(R) < _LEAST, 0, R))
    except np.linalg.LinAlgError as error:
        raise InvalidKeyframe(f"T_world_camera must hold a rotation, got {R.tolist()}") from error
    return np.asarray(U @ Vt, np.float64)


def _array(name: str, value: Any, dtypes: tuple[type, ...], shape: tuple[int | None, ...]) -> NDArray[Any]:
    expected = " or ".join(np.dtype(dtype).name for dtype in dtypes)
    if isinstance(value, np.ma.MaskedArray):  # a masked value is no return
        value = value.filled(np.nan if value.dtype.kind == "f" else 0)
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of unequal length
        raise InvalidKeyframe(f"{name} must be an array, got {type(value).__name__}: {error}") from error
    if array.dtype.type not in dtypes:
        raise InvalidKeyframe(f"{name} must be {expected}, got {array.dtype}")
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        free = iter("HW" if shape.count(None) == 2 else "N")
        wanted = "(" + ", ".join(next(free) if n is None else str(n) for n in shape) + ")"
        raise InvalidKeyframe(f"{name} must have shape {wanted}, got {array.shape}")
    if array.size == 0 and name in ("depth", "disparity"):
        raise InvalidKeyframe(f"{name} must not be empty, got shape {array.shape}")
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))


def _single(name: str, value: Any, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """Check an array's shape; convert it to float32, where too large numbers become infinite (no return)."""
    with np.errstate(over="ignore"):
        return _array(name, value, (np.float32, np.float64), shape).astype(np.float32, copy=False)


def _positive(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InvalidKeyframe(f"{name} must be a number, got {value!r}") from error
    if not np.isfinite(number) or number <= 0:
        raise InvalidKeyframe(f"{name} must be finite and > 0, got {value!r}")
    return number


def depth_metres(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return the z of a depth or disparity keyframe, (H, W) float64; 0 = no return."""
    if keyframe.disparity is not None:
        d = keyframe.disparity * keyframe.disparity_scale
        z = np.divide(keyframe.baseline_fx or 0.0, d, out=np.zeros(keyframe.shape), where=d > 0)
    else:
        z = keyframe.measurement.astype(np.float64)
        if keyframe.measurement.dtype == np.uint16:
            z *= keyframe.depth_scale
    return np.where(np.isfinite(z) & (z > 0), z, 0.0)


def points_camera(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return (n, 3) float64 points in the sensor's frame, of the valid pixels or of the points."""
    if keyframe.points is not None:
        return keyframe.points.astype(np.float64)
    z, K = depth_metres(keyframe), keyframe.intrinsics
    assert K is not None  # a keyframe with an image has a camera
    v, u = np.nonzero(z)
    z = z[v, u]
    return np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)


def points_world(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return `points_camera` moved by the keyframe's pose."""
    T = keyframe.T_world_camera
    moved: NDArray[np.float64] = points_camera(keyframe) @ T[:3, :3].T + T[:3, 3]
    return moved
