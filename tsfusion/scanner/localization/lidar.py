# SPDX-License-Identifier: MIT
"""Track point clouds with KISS-ICP (Vizzo et al. 2023): point-to-point ICP against a local map.

The steps of KISS-ICP are called one by one. So a scan that does not fit is kept out of the local map.
"""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe, needing
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry import se3, sweeps
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.geometry.inertial_sensors import GyroscopeTrust
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose, TrackingKeyframes

Points = NDArray[np.float64]  # (n, 3) metres

_log = logging.getLogger(__name__)

_INSTALL = "the localizer lidar needs kiss-icp; install: pip install '.[lidar]' in your clone of tsfusion"
MIN_POINTS = 30  # after thinning
MIN_UPRIGHT_POINTS = 50
MIN_OVERLAP = 0.7  # share of the points; measured: 0.86 and more in true scans, 0.5 to 0.7 in another street
MAX_SURPRISE = 3.0  # adaptive thresholds from the expected position: ICP does not search farther
MAX_TURN = np.radians(45)  # from the expected direction
SETTLING_SCANS = 4  # scans until the motion is known
WELL_ALIGNED = 0.9  # share of the points; until the motion is known, a pose with less is compared with others
STARTS = ((3, 0, 0), (-3, 0, 0), (0, 3, 0), (0, -3, 0))  # voxels from the expected pose, of the others
COLUMN_WIDTH, UPRIGHT_HEIGHT = 1.0, 0.5  # voxels; points of a higher column are upright
FINE_THRESHOLD = 0.5  # voxels, once the upright points are aligned
OUTDOOR_RANGE = 100.0  # metres; with a hundredth of it as voxel, KISS-ICP's own defaults
OUTDOORS_FROM = 20.0  # metres: if a hundredth of the points is farther away, the scan is outdoors
POINTS_A_VOXEL = 20
MAX_MISSED_SCANS = 10  # scans without a pose after which the motion is no longer extrapolated
TO_AND_FRO, LEAP = 6, 0.2  # scans in a row that undo the last change of motion; metres of such a change
TWO_SENSORS = "the scans leap to and fro, as those of two sensors do: scan the scans of one sensor alone"
KEYFRAME_DISTANCE = 2.0  # voxels to the next tracking keyframe


class LidarLocalizer(Localizer):
    """`Localizer` of point clouds, z up. Needs the extra `lidar`.

    KISS-ICP alone fails when the sensor moves fast from the first scan on. Rings on the ground look the same
    everywhere, and pull the pose back to the last one. Until the motion is known, upright points are aligned
    first. Range and voxel size are KISS-ICP's own outdoors; indoors the first scan's distances give them.
    """

    absolute = False

    def __init__(self) -> None:
        with needing(_INSTALL):
            import kiss_icp.kiss_icp
        self._make: Any = kiss_icp.kiss_icp.KissICP
        self._anchors = TrackingKeyframes()
        self._gyroscope = GyroscopeTrust()
        self._attitude: Attitude | None  # of the last scan in the map
        self._turn: NDArray[np.float64] | None  # since then, by a gyroscope
        self.reset()

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Find the sensor's pose at the frame's timestamp, in the axes of the first frame."""
        if frame.points is None:
            raise InvalidKeyframe(f"the localizer lidar follows points, got {frame.kind}")
        if self._icp is None:
            if len(frame.points) < MIN_POINTS:
                return _lost(frame, f"only {len(frame.points)} points to begin with")
            self._begin(frame.points)
        icp, turn = self._icp, self._gyroscope.turn(frame, self._attitude)
        self._note_period(frame)
        thin, map_points = icp.voxelize(self._straightened(frame, icp.last_delta))
        if len(thin) < MIN_POINTS:
            return self._fail(frame, f"only {len(thin)} points after thinning")
        T, quality = np.eye(4), 1.0
        if not icp.local_map.empty():
            found = self._align(thin, turn)
            if isinstance(found, str) and turn is not None:
                found = self._align(thin, None)
            if isinstance(found, str):
                return self._fail(frame, found)
            T, quality = found
            self._gyroscope.judge(turn, se3.inverse(icp.last_pose) @ T)
        begins = icp.local_map.empty()
        T = se3.nearest(self._accept(T, map_points, frame))
        motion = None
        if len(times := self._times(frame)) and not begins:
            motion = sweeps.steady(se3.log(icp.last_delta) / self._period_s, times)
        return self._anchors.pose(T, frame.timestamp_ns, quality=quality, motion=motion)

    def reset(self) -> None:
        self._icp: Any = None
        self._first: Frame | None = None
        self._T_first_map = np.eye(4)
        self._settling, self._missed = SETTLING_SCANS, 0
        self._last_ns, self._period_s = 0, 0.0
        self._attitude = self._turn = None
        self._change, self._leaps = np.zeros(3), 0
        self._anchors.reset()

    def _begin(self, points: NDArray[np.float32]) -> None:
        """Make a local map. Only one thread gives equal poses for equal scans."""
        from kiss_icp.config import KISSConfig
        from kiss_icp.config import config as kiss

        near, far = np.percentile(np.linalg.norm(points, axis=1), [50, 99])
        indoors = far < OUTDOORS_FROM
        voxel = max(float(near) / 10, 0.1) if indoors else OUTDOOR_RANGE / 100
        max_range = float(2 * far) if indoors else OUTDOOR_RANGE
        self._icp = self._make(
            KISSConfig(
                data=kiss.DataConfig(max_range=max_range, min_range=0.0, deskew=True),
                mapping=kiss.MappingConfig(voxel_size=voxel, max_points_per_voxel=POINTS_A_VOXEL),
                registration=kiss.RegistrationConfig(max_num_threads=1),
                adaptive_threshold=kiss.AdaptiveThresholdConfig(
                    initial_threshold=2 * voxel, min_motion_th=voxel / 10
                ),
            )
        )
        self._voxel = voxel
        self._anchors.distance = KEYFRAME_DISTANCE * voxel

    def _expected(self) -> se3.Transform:
        """Predict the pose from the last motion, also over missed scans. After many, return the last pose.

        A gyroscope tells the turn.
        """
        steps = self._missed + 1 if self._missed < MAX_MISSED_SCANS else 0
        motion = se3.exp(se3.log(self._icp.last_delta) * steps)
        if self._turn is not None:
            motion[:3, :3] = self._turn
        T: se3.Transform = self._icp.last_pose @ motion
        return T

    def _align(self, thin: Points, turn: NDArray[np.float64] | None) -> tuple[se3.Transform, float] | str:
        """Return the pose of a scan and the share of its points that overlap the map, or a problem."""
        self._turn = turn
        T, quality = self._aligned(thin, self._expected())
        if self._settling and quality < WELL_ALIGNED:  # along a street, all looks alike some metres on
            starts = self._expected() @ se3.exp(self._voxel * np.pad(STARTS, ((0, 0), (0, 3))))
            others = (self._aligned(thin, start) for start in starts)
            T, quality = max([(T, quality), *others], key=lambda found: found[1])
        return self._problem(T, quality) or (T, quality)

    def _aligned(self, thin: Points, guess: se3.Transform) -> tuple[se3.Transform, float]:
        """Return the pose found from a guess, and the share of the scan's points that overlap the map."""
        icp, threshold = self._icp, self._icp.adaptive_threshold.get_threshold()
        if self._settling:
            upright, around = thin[_is_upright(thin, self._voxel)], self._upright_map()
            if len(upright) >= MIN_UPRIGHT_POINTS and not around.empty():
                guess = icp.registration.align_points_to_map(upright, around, guess, 3 * threshold, threshold)
                threshold = FINE_THRESHOLD * self._voxel
        T: se3.Transform = icp.registration.align_points_to_map(
            thin, icp.local_map, guess, 3 * threshold, threshold
        )
        if not np.isfinite(T).all():
            return guess, 0.0
        return T, _overlap(se3.apply(T, thin), icp.local_map.point_cloud(), self._voxel)

    def _upright_map(self) -> Any:
        from kiss_icp.mapping import VoxelHashMap

        cloud = self._icp.local_map.point_cloud()
        made = VoxelHashMap(self._voxel, self._icp.config.data.max_range, POINTS_A_VOXEL)
        made.add_points(cloud[_is_upright(cloud, self._voxel)])
        return made

    def _problem(self, T: se3.Transform, overlap: float) -> str:
        """Return the reason to reject the pose, or "" to accept it."""
        if overlap < MIN_OVERLAP:
            return f"{overlap:.0%} of the points lie where some were before"
        surprise = se3.inverse(self._expected()) @ T
        reach = MAX_SURPRISE * self._icp.adaptive_threshold.get_threshold()
        if se3.distance(surprise) > reach or se3.angle(surprise) > MAX_TURN:
            return (
                f"a jump of {se3.distance(surprise):.2f} m and {np.degrees(se3.angle(surprise)):.0f}° from "
                "where the motion led"
            )
        return ""

    def _note_period(self, frame: Frame) -> None:
        """Set the seconds between scans: from the stamps if there are any, but at least those of a sweep.

        Scans that are missing between two sweeps, by their stamps, count as missed.
        """
        times = self._times(frame)
        since_s = (frame.timestamp_ns - self._last_ns) / 1e9 if self._last_ns else 0.0
        if len(times) and self._first is None and self._period_s:
            self._missed = max(self._missed, round(since_s / self._period_s) - 1)
        self._period_s = max(since_s / (self._missed + 1), float(np.ptp(times)) if len(times) else 0.0)

    def _straightened(self, frame: Frame, motion: se3.Transform) -> Points:
        """Return the points in range, in the sensor's axes at the scan's end."""
        assert frame.points is not None
        times = self._times(frame)
        if len(times):
            motion = se3.exp(float(np.ptp(times)) / self._period_s * se3.log(motion))
        scan: Points = self._icp.preprocessor.preprocess(frame.points.astype(np.float64), times, motion)
        return scan

    def _times(self, frame: Frame) -> NDArray[np.float64]:
        """Return the times of the points, (N,) seconds, or (0,) if all points have the same time."""
        times = frame.point_times_s
        if times is None or np.ptp(times) <= 0:
            return np.zeros(0)
        return times.astype(np.float64)

    def _from_stamp(self, frame: Frame) -> se3.Transform:
        """Return the sensor's pose at the scan's end, in the sensor's axes at the frame's timestamp."""
        times = self._times(frame)
        end = float(times.max()) / self._period_s if len(times) else 0.0
        return se3.exp(end * se3.log(self._icp.last_delta))

    def _accept(self, T: se3.Transform, map_points: Points, frame: Frame) -> se3.Transform:
        """Put the scan into the local map. Return the sensor's pose at the frame's timestamp."""
        icp = self._icp
        moved = se3.exp(se3.log(se3.inverse(icp.last_pose) @ T) / (self._missed + 1))
        if icp.local_map.empty():
            self._first = frame
        else:
            icp.adaptive_threshold.update_model_deviation(se3.inverse(self._expected()) @ T)
            self._notice_two_sensors(moved[:3, 3] - icp.last_delta[:3, 3])
        icp.last_delta, before, icp.last_pose = moved, icp.last_pose, T
        if self._first is not None and self._first is not frame:
            if len(self._times(self._first)):  # both scans were straightened for a sensor at rest
                icp.local_map.clear()
                icp.local_map.update(icp.voxelize(self._straightened(self._first, moved))[1], before)
                map_points = icp.voxelize(self._straightened(frame, moved))[1]
                self._T_first_map = self._from_stamp(self._first)
            self._first = None
        icp.local_map.update(map_points, T)
        self._missed, self._settling = 0, max(0, self._settling - 1)
        is_later = frame.timestamp_ns > self._last_ns  # else its stamp tells nothing of the next period
        self._last_ns = frame.timestamp_ns if is_later else self._last_ns + round(1e9 * self._period_s)
        self._attitude = frame.attitude
        return self._T_first_map @ T @ se3.inverse(self._from_stamp(frame))

    def _notice_two_sensors(self, change: NDArray[np.float64]) -> None:
        """Warn if each scan undoes the last change of motion, (3,) metres: no sensor moves so."""
        size = min(float(np.linalg.norm(each)) for each in (change, self._change))
        self._leaps = self._leaps + 1 if change @ self._change < -(max(size, LEAP) ** 2) / 2 else 0
        self._change = change
        if self._leaps == TO_AND_FRO:
            _log.warning(TWO_SENSORS)

    def _fail(self, frame: Frame, reason: str) -> Lost:
        """Count a scan without a pose. The next scan's pose is searched around the last good one."""
        self._missed += 1
        self._settling = SETTLING_SCANS
        return _lost(frame, reason)


def _lost(frame: Frame, reason: str) -> Lost:
    return Lost(reason=reason, timestamp_ns=frame.timestamp_ns)


def _is_upright(points: Points, voxel: float) -> NDArray[np.bool_]:
    """Return True for points in a column with more height than the ground: (n, 3) → (n,)."""
    cells = np.floor(points[:, :2] / (COLUMN_WIDTH * voxel)).astype(np.int64)
    _, column = np.unique(cells, axis=0, return_inverse=True)
    lowest, highest = np.full(len(points), np.inf), np.full(len(points), -np.inf)
    np.minimum.at(lowest, column.ravel(), points[:, 2])
    np.maximum.at(highest, column.ravel(), points[:, 2])
    upright: NDArray[np.bool_] = (highest - lowest)[column.ravel()] > UPRIGHT_HEIGHT * voxel
    return upright


def _overlap(points: Points, around: Points, voxel: float) -> float:
    """Return the share of the points that have a point of the map in their voxel or next to it."""
    occupied = distinct(_keys(around, voxel))
    keys = _keys(points, voxel)
    hit = np.zeros(len(keys), bool)
    for step in (0, 1, -1, 1 << 21, -(1 << 21), 1 << 42, -(1 << 42)):
        place = np.minimum(np.searchsorted(occupied, keys + step), len(occupied) - 1)
        hit |= occupied[place] == keys + step
    return float(hit.mean())


def _keys(points: Points, voxel: float) -> NDArray[np.int64]:
    """Return the number of each point's voxel, 21 bits an axis: (n, 3) → (n,)."""
    cells = np.floor(points / voxel).astype(np.int64) + (1 << 20)
    keys: NDArray[np.int64] = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
    return keys
