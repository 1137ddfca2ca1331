# SPDX-License-Identifier: MIT
"""Read scans from the packets of a Velodyne or an Ouster, by the libraries made for them."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tsfusion.core.errors import DatasetError, MissingDependency, needing, refusals_as
from tsfusion.datasets.dataset import SCAN, Frames, NoPoses, SeveralRecordings, require_frames
from tsfusion.datasets.scan_files import Scan
from tsfusion.geometry.frame import Frame

EXPECTED = (
    "a .pcap of a Velodyne's or an Ouster's packets (Ouster's with its .json), an Ouster's .osf or .bag"
)
_ENDINGS = (".pcap", ".pcapng", ".osf")
_VELODYNE_BYTES, _HEADERS = 1206, range(28, 80)  # of a packet's content, and of what precedes it in a record
_MAGIC = (b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\xa1\xb2\x3c\x4d")
_NEXT_GENERATION = b"\n\r\r\n"  # a pcapng, which Wireshark writes and velodyne-decoder cannot read
_END_BYTES = 1 << 20  # of a bag, at its start and its end, where types are named
_TRIED = 500  # packets; the others are of the same LiDAR
_NO_OUSTER = (
    "{}: an Ouster's packets are read by ouster-sdk, which pins older versions of other packages: "
    "pip install --no-deps ouster-sdk; without it, another driver makes PointCloud2 or PCD of them"
)
Sweeps = Iterator[tuple[int, Scan]]  # nanoseconds, and the scan


def recognises(path: Path) -> bool:
    """Return True for a file of packets, and for a folder with such files."""
    return bool(_files(path))


def _files(path: Path) -> list[Path]:
    """Return the path itself if it is a file of packets, or such files in a folder, Ouster's bags last."""
    inside = [path] if path.is_file() else sorted(path.glob("[!.]*"))
    captured = [file for file in inside if file.suffix.lower() in _ENDINGS]
    bags = inside if captured or path.is_file() else []
    return [*captured, *(file for file in bags if _is_ouster_bag(file))]


def _is_ouster_bag(path: Path) -> bool:
    """Return True for a ROS 1 bag with an Ouster's packets and without clouds made of them."""
    if path.suffix.lower() != ".bag":
        return False
    ends = b""
    with suppress(OSError), path.open("rb") as file:
        ends = file.read(_END_BYTES)
        file.seek(max(0, path.stat().st_size - _END_BYTES))
        ends += file.read(_END_BYTES)
    return b"ouster_ros/PacketMsg" in ends and b"sensor_msgs/PointCloud2" not in ends


class LidarPackets(Frames):
    """Scans in the LiDAR's axes, with the times of their points, and no poses.

    Opening reads the recording once. Scans are read in order, and from the start after a step back.

    Args:
        path: the file, or the folder that holds it.
        deskew: False ignores the times of points.
        posed: True is refused, as there are no poses; a scan finds them, or `--trajectory` gives them.

    Raises:
        MissingDependency: the library for these packets is not installed.
        DatasetError: the packets are of another LiDAR, or damaged, or the metadata is missing.
    """

    def __init__(
        self, path: str | Path, *, deskew: bool = True, sensor: str = "lidar", posed: bool = True
    ) -> None:
        given = Path(path).expanduser()
        found = _files(given)
        if len(found) > 1:
            names = ", ".join(file.name for file in found)
            raise SeveralRecordings(
                f"{given} holds {len(found)} files of packets ({names}); open one of them"
            )
        self._path = found[0] if found else given
        self.sensor, self.skipped, self._deskew = sensor, {}, deskew
        is_captured = self._path.suffix.lower() in _ENDINGS[:2]
        self._start: Callable[[], Sweeps] = partial(
            _velodyne if is_captured and _is_velodyne(self._path) else _ouster, self._path
        )
        self.name = f"{self._path.suffix[1:].upper()} {self._path.name}"
        stamps = [stamp for stamp, _ in _checked(self._start, self._path)]
        require_frames(len(stamps), self._path, EXPECTED, self.skipped)
        self.timestamps_ns, self._poses = np.array(stamps, np.int64), [None] * len(stamps)
        self._sweeps, self._next = _checked(self._start, self._path), 0
        if posed:
            raise NoPoses(f"{self._path} has no poses; {SCAN}")

    def __len__(self) -> int:
        return len(self._poses)

    def _frame(self, index: int) -> Frame:
        if index < self._next:
            self._sweeps, self._next = _checked(self._start, self._path), 0
        for _, scan in self._sweeps:
            self._next += 1
            if self._next > index:
                return self._sweep(index, scan)
        raise DatasetError(f"{self._path} ended before scan {index}: did it change?")


def _checked(start: Callable[[], Sweeps], path: Path) -> Sweeps:
    try:
        yield from start()
    except (ImportError, DatasetError, MissingDependency):
        raise
    except Exception as error:  # of a library, about what it found
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise DatasetError(f"{path} cannot be read ({why}); expected {EXPECTED}") from error


def _is_velodyne(path: Path) -> bool:
    """Return True if packets at the start have the size of a Velodyne's.

    Raises:
        DatasetError: they have not, and no metadata of an Ouster is there.
    """
    with refusals_as(DatasetError, f"cannot read {path}"), path.open("rb") as file:
        head = file.read(24)
        order: Literal["little", "big"] = "little" if head[:4] in _MAGIC[:2] else "big"
        sizes: list[int] = []
        while head[:4] in _MAGIC and len(sizes) < _TRIED and len(record := file.read(16)) == 16:
            sizes.append(int.from_bytes(record[8:12], order))
            file.seek(sizes[-1], 1)
    if any(size - _VELODYNE_BYTES in _HEADERS for size in sizes):
        return True
    if not any(path.parent.glob("*.json")):
        if head[:4] == _NEXT_GENERATION:
            raise DatasetError(f"{path} is a pcapng; write it as pcap first: editcap -F pcap A.pcapng B.pcap")
        raise DatasetError(
            f"{path} has no packets of a Velodyne, and an Ouster's need the sensor's metadata (.json) beside "
            "it; of another LiDAR's, its vendor's driver makes PointCloud2 or PCD"
        )
    return False


def _velodyne(path: Path) -> Sweeps:
    with needing(f"{path}: a Velodyne's packets need velodyne-decoder: pip install '.[velodyne]'"):
        import velodyne_decoder
    for stamp, points in velodyne_decoder.read_pcap(str(path), as_pcl_structs=True):
        xyz = np.column_stack([points[axis] for axis in "xyz"])
        yield round(stamp.host * 1e9), Scan(xyz, "time", points["time"])


def _ouster(path: Path) -> Sweeps:
    with needing(_NO_OUSTER.format(path)):
        from ouster.sdk import core, open_source
    source: Any = open_source(str(path))
    if len(source.sensor_info) != 1:
        raise DatasetError(f"{path} is of {len(source.sensor_info)} sensors; expected one: split it first")
    project = core.XYZLut(source.sensor_info[0])
    for found in source:
        for sweep in filter(None, found):
            ranges = np.asarray(sweep.field("RANGE"))
            points = np.asarray(project(sweep), np.float32)
            points[ranges == 0] = np.nan
            stamps = np.asarray(sweep.timestamp).astype(np.int64)
            known = stamps[stamps > 0]
            if len(known):
                moments = np.broadcast_to(stamps, ranges.shape).ravel()
                points[:, stamps <= 0] = np.nan
                yield int(known[0]), Scan(points.reshape(-1, 3), "t", moments)
