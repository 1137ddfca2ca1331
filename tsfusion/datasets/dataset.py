# SPDX-License-Identifier: MIT
"""Define the `Dataset` protocol and the base class of recordings; select some of a dataset's frames."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, TypeVar, overload, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core.errors import DatasetError, InvalidKeyframe, TsfusionError
from tsfusion.datasets.color_placement import ColorPlace
from tsfusion.datasets.readers import check_byte_order
from tsfusion.datasets.scan_files import PointTimes, Scan, point_times
from tsfusion.geometry import origin, se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope, inertial_fields
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.object_cards import ShownRecording
from tsfusion.geometry.origin import Origin, System
from tsfusion.geometry.sweeps import Motion, motion_about
from tsfusion.geometry.trajectory import PoseAt

STREET = MappingProxyType({"voxel_size": 0.1})  # usual in a street: at 2 cm, a stereo keyframe takes 1.5 s
NOMINAL_NS = 33_333_333  # between frames of a recording without times: 30 frames a second
SCAN = "`tsfusion scan PATH` finds poses by itself"
WITHOUT_DEPTH = "without depth"
WITHOUT_POSE = "without a pose"  # start of the reason for frames left out for want of a pose
NO_POSE_IN_TIME = f"{WITHOUT_POSE} in time"
NO_HALF = "without their other half"  # for images of a stereo camera
UNREADABLE = "unreadable"  # for frames that are left out while reading
CLOCK = "after the clock"  # start of the reason for frames after a step back of the clock
_LATE_NS = 50_000_000  # a stamp can be so late, because of threads or exposure
_FEWEST_TIMES, _MOST_PARTS = 10, 100  # mean times in a part; with more parts, a series has no order
_FIRST_TRIES = 50  # so many unreadable frames, with no readable one before, mean that all are
_T = TypeVar("_T")
Times = NDArray[np.int64] | None  # (n,) nanoseconds of a recording's frames; None = not recorded
FramePoses = Sequence[NDArray[np.float64] | None]  # (4, 4) T_world_camera or None of each frame

log = logging.getLogger(__name__)


class UnreadableFrame(DatasetError):
    """A frame of a recording cannot be read. It counts in `skipped`; most other frames can be read."""


class UnreadableRecording(DatasetError):
    """Most frames of a recording cannot be read."""


class NoPoses(DatasetError):
    """A recording has no poses of its own, so poses must come from a file or a localizer."""


class SeveralRecordings(DatasetError):
    """A folder holds several recordings. Each must be opened by its own path."""


@runtime_checkable
class Dataset(Protocol):
    """Keyframes by index, as `replay` needs them.

    A dataset for a localizer also has `frame(index)`, as in `Frames`.

    Attributes:
        name: for reports.
        sensor: name of the sensor model (`kinect`, `tof`, `stereo`, `lidar`).
        timestamps_ns: (n,) int64 nanoseconds of the sensor's clock; None if none were recorded.
        skipped: reason → number of frames left out while opening.
    """

    name: str
    sensor: str
    timestamps_ns: NDArray[np.int64] | None
    skipped: dict[str, int]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Keyframe: ...

    def __iter__(self) -> Iterator[Keyframe]: ...


class Frames(ShownRecording):
    """Base class of recordings: indexing and iteration over `_frame(index)`, which opens the frame's files.

    A frame that cannot be read raises UnreadableFrame, and iteration leaves it out. If most frames cannot be
    read, UnreadableRecording is raised.
    """

    camera: Any = None  # `cameras.RecordedCamera` of depth images; None for points
    depth_unit: Any = None  # `cameras.DepthUnit` of integer depth
    along_ray: bool = False  # True if depth was measured along each pixel's ray; `frame` returns z
    timestamps_ns: NDArray[np.int64] | None = None
    quaternions: bool = False  # True if rotations were recorded as quaternions, False = matrices
    usual: Mapping[str, Any] = MappingProxyType({})  # usual settings of a map (`VolumeConfig`)
    origin: Origin | None = None  # subtracted from the poses' positions
    system: System = System()  # of the recorded positions
    _poses: Sequence[NDArray[np.float64] | None] = ()
    _deskew = True  # False ignores the times of points
    _between: Callable[[], PoseAt] | None = None  # makes `_pose_at`; None = only frames have poses
    _accelerometer, _gyroscope = Accelerometer(), Gyroscope()  # empty, for recordings without them
    _unread: Mapping[int, str] = MappingProxyType({})  # index → why the frame cannot be read
    _was_read: bool = False  # True once a frame was read

    @property
    def color_place(self) -> ColorPlace | None:
        """Colour camera, if edges show that colour is not registered to depth; `frame` then registers it."""
        return None

    @abstractmethod
    def _frame(self, index: int) -> Frame: ...

    def frame(self, index: int) -> Frame:
        """Return the measurement, with `T_world_camera` if the recording has a pose for it."""
        index = self._checked(index)
        try:
            frame = self._frame(index)
            if frame.depth is not None:
                check_byte_order(frame.depth, f"keyframe {index} of {self.name}")
        except (DatasetError, InvalidKeyframe) as error:
            raise self._left_out(index, error) from error
        self._was_read = True
        return frame.along_axis() if self.along_ray else frame

    def _left_out(self, index: int, error: TsfusionError) -> DatasetError:
        """Count an unreadable frame. Return its error; or UnreadableRecording if most frames have one."""
        if isinstance(error, UnreadableRecording):
            return error
        unnamed = f"keyframe {index} of {self.name}: " if isinstance(error, InvalidKeyframe) else ""
        why = f"{unnamed}{error}"
        if not self._unread and not isinstance(error, UnreadableFrame):
            log.warning("frame %d of %s is left out: %s", index, self.name, why)
        self._unread = {**self._unread, index: why}
        bad = self.skipped[UNREADABLE] = len(self._unread)
        if 2 * bad <= len(self) and (self._was_read or bad < _FIRST_TRIES):
            return UnreadableFrame(why)
        others = f"; {bad} of {len(self)} frames of {self.name} cannot be read" if bad > 1 else ""
        return UnreadableRecording(next(iter(self._unread.values())) + others)

    def pose(self, index: int) -> NDArray[np.float64] | None:
        """Return (4, 4) T_world_camera as recorded, or None; read no image if possible."""
        index = self._checked(index)
        return self._poses[index] if self._poses else self.frame(index).T_world_camera

    def take_off_origin(self, wanted: object = None, crs: str | None = None) -> None:
        """Choose an origin (`origin.found`) and subtract it from all positions, which become metres.

        Raises:
            InvalidConfig: the origin or the reference system is impossible.
        """
        self.system, self.origin = self.system if crs is None else origin.system(str(crs)), None
        positions = [self._counted(T[:3, 3]) for T in self._poses if T is not None]
        self.origin = origin.found(positions, wanted, self.system.crs)
        self._poses = [self._counted_pose(T) for T in self._poses]

    def _counted(self, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return recorded positions, (…, 3), as metres from the recording's origin."""
        zero = np.zeros(3) if self.origin is None else np.array(self.origin.position)
        return np.asarray(positions * np.array(self.system.metres) - zero)

    def _counted_pose(self, T: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if T is None else se3.transform(T[:3, :3], self._counted(T[:3, 3]))

    @overload
    def __getitem__(self, index: int) -> Keyframe: ...

    @overload
    def __getitem__(self, index: slice) -> "PartOfDataset": ...

    def __getitem__(self, index: int | slice) -> "Keyframe | PartOfDataset":
        if isinstance(index, slice):
            return PartOfDataset(self, range(len(self))[index])
        return self._keyframe(self._checked(index))

    def _keyframe(self, index: int) -> Keyframe:
        frame = self.frame(index)
        if frame.T_world_camera is None:
            raise DatasetError(f"frame {index} of {self.name} has no pose; {SCAN}")
        return frame.keyframe(frame.T_world_camera, frame.motion)

    def _first(self) -> Frame:
        return first_frame(self)

    def __iter__(self) -> Iterator[Keyframe]:
        return (keyframe for _, keyframe in readable(self.__getitem__, range(len(self))))

    def _checked(self, index: int) -> int:
        count = len(self)
        if not -count <= index < count:
            raise IndexError(f"{self.name} has {count} keyframes, got index {index}")
        return index % count

    def _keep(
        self,
        files: Sequence[_T],
        poses: FramePoses,
        where: tuple[Path, str],
        *,
        posed: bool,
        reason: str = WITHOUT_POSE,
    ) -> list[_T]:
        """Return the files of the frames to keep, and set `_poses`. If `posed`, keep only frames with a pose.

        Args:
            where: the folder and the expected files, for the error if no frame is left.
            reason: why frames are left out, for `skipped`.
        """
        pairs = [pair for pair in zip(files, poses, strict=True) if pair[1] is not None or not posed]
        if len(pairs) < len(files):
            self.skipped[reason] = self.skipped.get(reason, 0) + len(files) - len(pairs)
        require_frames(len(pairs), *where, self.skipped)
        self._poses = [pose for _, pose in pairs]
        return [file for file, _ in pairs]

    def _posed_frame(self, index: int, **measurement: Any) -> Frame:
        """Return a frame with the recorded pose, sensor and time of an index."""
        T, stamp = self._poses[index], self._stamp(index)
        measured = inertial_fields(self._accelerometer, self._gyroscope, stamp) | measurement
        return Frame(T_world_camera=T, sensor=self.sensor, timestamp_ns=stamp, **measured)

    def _sweep(self, index: int, scan: Scan) -> Frame:
        """Return a frame of a LiDAR scan with recorded pose and, if known, point times and motion."""
        stamps = self.timestamps_ns
        between_s = 1.0 if stamps is None or len(stamps) < 2 else float(np.median(np.diff(stamps))) / 1e9
        found = point_times(scan, self._stamp(index), between_s) if self._deskew else PointTimes()
        motion = self._motion(index, found.point_times_s)
        return self._posed_frame(
            index, points=scan.points, color=scan.color, motion=motion, **found._asdict()
        )

    @cached_property
    def _pose_at(self) -> PoseAt:
        """Function from a time in nanoseconds to T_world_camera or None, also between frames."""
        recorded: PoseAt = (lambda _: None) if self._between is None else self._between()
        return lambda stamp_ns: self._counted_pose(recorded(stamp_ns))

    def _motion(self, index: int, times_s: NDArray[np.float32] | None) -> Motion | None:
        """Return the sensor's motion during a frame's sweep, from recorded poses, or None."""
        if times_s is None or self.timestamps_ns is None:
            return None
        return motion_about(self._pose_at, self._stamp(index), times_s)

    def _stamp(self, index: int) -> int:
        return 0 if self.timestamps_ns is None else int(self.timestamps_ns[index])


class Wrapped(Frames):
    """Chosen frames of another dataset.

    `distance`: the other dataset's function for the distance from a world's true surface, if it has one.
    """

    distance: Callable[[NDArray[np.floating]], NDArray[np.float64]]

    def __init__(self, dataset: Dataset, indices: Sequence[int]) -> None:
        self.name, self.sensor, self.skipped = dataset.name, dataset.sensor, dataset.skipped
        self._dataset = dataset
        for name in ("camera", "depth_unit", "quaternions", "usual", "origin", "distance"):
            if hasattr(dataset, name):
                setattr(self, name, getattr(dataset, name))
        self._choose(indices)

    @property
    def color_place(self) -> ColorPlace | None:
        return getattr(self._dataset, "color_place", None)

    def _choose(self, indices: Sequence[int]) -> None:
        self._indices, stamps = list(indices), self._dataset.timestamps_ns
        self.timestamps_ns = None if stamps is None else stamps[self._indices]

    def __len__(self) -> int:
        return len(self._indices)

    def _frame(self, index: int) -> Frame:
        return frame_of(self._dataset, self._indices[index])


class PartOfDataset(Wrapped):
    """Selected keyframes of another dataset, made by `select`."""

    def pose(self, index: int) -> NDArray[np.float64] | None:
        return pose_of(self._dataset, self._indices[self._checked(index)])

    def _keyframe(self, index: int) -> Keyframe:
        try:
            return self._dataset[self._indices[index]]
        except DatasetError as error:
            raise self._left_out(index, error) from error


def frame_of(dataset: Dataset, index: int) -> Frame:
    """Return frame `index` of any dataset, from its `frame` if it has one, else from the keyframe.

    A keyframe without a sensor gives a frame without one. The caller must then name the sensor.
    """
    own: Callable[[int], Frame] | None = getattr(dataset, "frame", None)
    return own(index) if own is not None else Frame.of(dataset[index], "")


def readable(read: Callable[[int], _T], indices: Iterable[int]) -> Iterator[tuple[int, _T]]:
    """Yield each index with the result of `read`. Leave out those for which it raises UnreadableFrame."""
    for index in indices:
        try:
            found = read(index)
        except UnreadableFrame:
            continue
        yield index, found


def first_frame(dataset: Dataset) -> Frame:
    """Return the first readable frame. Raises DatasetError if there is none."""
    found = readable(partial(frame_of, dataset), range(len(dataset)))
    return next((frame for _, frame in found), None) or frame_of(dataset, 0)


def pose_of(dataset: Dataset, index: int) -> NDArray[np.float64] | None:
    """Return the recorded (4, 4) T_world_camera of frame `index` of any dataset, or None."""
    own: Callable[[int], NDArray[np.float64] | None] | None = getattr(dataset, "pose", None)
    return own(index) if own is not None else dataset[index].T_world_camera


def poses_if_any(
    read: Callable[[], FramePoses], count: int, *, posed: bool, guessed: bool = False
) -> FramePoses:
    """Return the poses of `count` frames, or None for each if the recording has no poses.

    Args:
        posed: True makes missing poses an error.
        guessed: True if the file of poses was found by its name alone. A file that does not fit is then only
            a warning, unless `posed`.
    """
    try:
        return read()
    except DatasetError as error:
        if posed or not (guessed or isinstance(error, NoPoses)):
            raise
        if not isinstance(error, NoPoses):
            log.warning("the recorded poses are not used: %s", error)
    return [None] * count


def select(
    dataset: Dataset, *, start: int = 0, stop: int | None = None, stride: int = 1, limit: int | None = None
) -> PartOfDataset:
    """Return every `stride`-th keyframe of `dataset[start:stop]`, at most `limit` of them.

    Raises:
        DatasetError: no keyframe is left.
    """
    if stride < 1:
        raise DatasetError(f"stride must be >= 1, got {stride}")
    if limit is not None and limit < 1:
        raise DatasetError(f"limit must be >= 1, got {limit}")
    indices = range(len(dataset))[start:stop:stride][:limit]
    if not indices:
        kept = f"after the first {start}" if stop is None else f"from {start} up to {stop}"
        raise DatasetError(f"{dataset.name} has {len(dataset)} keyframes, none {kept}")
    return PartOfDataset(dataset, indices)


def nearest_in_time(sorted_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the index in `sorted_ns` (not empty) nearest to each of `stamps_ns`; of equals the first."""
    right = np.minimum(np.searchsorted(sorted_ns, stamps_ns), len(sorted_ns) - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.abs(sorted_ns[left] - stamps_ns) <= np.abs(sorted_ns[right] - stamps_ns)
    return np.searchsorted(sorted_ns, sorted_ns[np.where(nearer, left, right)])


def partners_in_time(
    there_ns: Sequence[int] | NDArray[np.int64], stamps_ns: Sequence[int] | NDArray[np.int64], most_ns: int
) -> list[int | None]:
    """Return the index in `there_ns` (sorted) that is nearest to each stamp, or None if all are farther.

    Args:
        most_ns: largest difference of two times that belong together, nanoseconds.
    """
    there, wanted = np.asarray(there_ns, np.int64), np.asarray(stamps_ns, np.int64)
    if not len(there):
        return [None] * len(wanted)
    nearest = nearest_in_time(there, wanted)
    near = np.abs(there[nearest] - wanted) <= most_ns
    return [int(index) if good else None for index, good in zip(nearest, near, strict=True)]


def clock_parts(stamps_ns: ArrayLike) -> list[slice]:
    """Split a series of times, (n,) nanoseconds as recorded, where its clock steps back.

    A single late time, times before all times of the part, and a series without any order are no steps.
    """
    stamps, begin = np.asarray(stamps_ns, np.int64), 0
    parts: list[slice] = []
    while len(stamps) and len(parts) < max(2, min(_MOST_PARTS, len(stamps) // _FEWEST_TIMES)):
        rest = stamps[begin:]
        late = rest < np.maximum.accumulate(rest) - _LATE_NS
        step = int(np.argmax(late & np.append(late[1:], late[-1:])))
        if not step or rest[step:].max() < rest[:step].min():
            return [*parts, slice(begin, None)]
        parts.append(slice(begin, begin + step))
        begin += step
    return [slice(None)]


def require_one_clock(stamps_ns: Sequence[int], path: Path) -> None:
    """Raise DatasetError if the times of a list of frames, in its order, step back (`clock_parts`).

    Times sorted as text, 10.5 before 9.5, are allowed.
    """
    parts = clock_parts(stamps_ns)
    texts = [f"{stamp / 1e9:.9f}" for stamp in stamps_ns] if len(parts) > 1 else []
    if texts != sorted(texts):
        begin = parts[1].start
        back_s = (max(stamps_ns[:begin]) - stamps_ns[begin]) / 1e9
        raise DatasetError(
            f"{path}: the clock steps back by {back_s:.2f} s at entry {begin + 1}, so that times before and "
            "after are mixed; cut the list there, and read each part alone"
        )


def require_folder(path: str | Path, layout: str) -> Path:
    """Return `path` as an existing folder. Raises DatasetError for anything else."""
    path = Path(path).expanduser()
    if not path.is_dir():
        wrong = "is not a folder" if path.exists() else "does not exist"
        raise DatasetError(f"{path} {wrong}; expected a folder in the {layout} layout")
    return path


def require_frames(count: int, path: Path, expected: str, skipped: dict[str, int]) -> None:
    if count:
        return
    reasons = "; ".join(f"{number} {reason}" for reason, number in skipped.items() if number)
    raise DatasetError(
        f"{path} holds no usable frames; expected {expected}" + (f" ({reasons})" if reasons else "")
    )
