# SPDX-License-Identifier: MIT
"""Synthetic worlds rendered once and kept as files: drives in KITTI's layout, depth cameras in CoRBS'.

The folder appears when it is whole. Until then the pictures lie beside it, and the next call goes on there.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.worlds.street_drive import StreetDrive
from tsfusion.core.durable_files import make_folder, replacing, sync_folder
from tsfusion.core.errors import DatasetError
from tsfusion.core.folder_lock import hold
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.datasets.worlds.synthetic import DEPTH_SCALE, Synthetic

ABOUT = "world.json"
CORBS = "D1_pre_registereddata"  # as CoRBS names the folder of a scene: its camera is known by that
_PER_METRE = 5000  # TUM's and CoRBS' depth units
_EPOCH_NS = 10**9  # of the first frame: 0 means that a time is not known
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # noise does not compress: more effort saves 3 %


def record(
    world: StreetDrive | Synthetic,
    folder: Path,
    *,
    color: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a world into a folder that `open_dataset` reads; at once where it is there already.

    A drive: KITTI's `sequences/NN` with calib.txt, times.txt and images, and `poses/NN.txt`. A depth camera:
    CoRBS' lists of images and groundtruth.txt, depth in 0.2 mm.

    Args:
        color: write a drive's left colour images (`image_2`) too; half as much again on the disk.
        progress: called with the number of frames that are done, and of all.

    Raises:
        DatasetError: a world without images, another one is there, another process renders it, or the disk
            refuses.
    """
    files = _KittiFiles(world, color) if isinstance(world, StreetDrive) else _CorbsFiles(world)
    about = {"world": world.name, "frames": len(world), "color": color, "fingerprint": files.fingerprint()}
    folder = folder.absolute()
    if folder.exists():
        if _read_about(folder) != about:
            raise DatasetError(f"{folder} holds something else than {world.name}; choose another folder")
        return
    partial, lock = (folder.with_name(f".{folder.name}.{kind}") for kind in ("partial", "lock"))
    try:
        make_folder(folder.parent)
        with hold(folder.parent, lock.name):
            if partial.exists() and _read_about(partial) != about:
                shutil.rmtree(partial)
            partial.mkdir(exist_ok=True)
            _write(partial / ABOUT, json.dumps(about, indent=1))
            _render(files, partial, len(world), progress)
            os.replace(partial, folder)
            sync_folder(folder.parent)
        lock.unlink(missing_ok=True)
    except BlockingIOError as error:
        raise DatasetError(f"another process renders {folder}; wait until it has finished") from error
    except OSError as error:
        raise DatasetError(f"cannot write {folder}: {error.strerror}; choose another folder") from error


class _Files(Protocol):
    """A layout, and the world that is written in it."""

    def fingerprint(self) -> str:
        """Hash of what would be written."""

    def begin(self, root: Path) -> None:
        """Write everything but the images."""

    def images(self, index: int) -> dict[str, NDArray[Any]]:
        """Images of a frame by their path below the root, rendered."""

    def last(self, index: int) -> str:
        """Path of the image that is written last."""


def _render(files: _Files, root: Path, count: int, progress: Callable[[int, int], None] | None) -> None:
    files.begin(root)
    for index in range(count):
        if not (root / files.last(index)).exists():
            for name, image in files.images(index).items():
                _write_image(root / name, image)
        if progress is not None:
            progress(index + 1, count)


class _KittiFiles:
    def __init__(self, drive: StreetDrive, color: bool) -> None:
        self._drive, self._number = drive, drive.drive.sequence
        self._names = ("image_0", "image_1", "image_2")[: 2 + color]

    def fingerprint(self) -> str:
        return self._drive.fingerprint()

    def begin(self, root: Path) -> None:
        drive, place = self._drive, root / "sequences" / self._number
        for name in self._names:
            (place / name).mkdir(parents=True, exist_ok=True)
        (root / "poses").mkdir(exist_ok=True)
        lines = drive.poses_file.read_text(encoding="utf-8").splitlines()[: len(drive)]
        _write(root / "poses" / f"{self._number}.txt", "\n".join(lines))
        assert drive.timestamps_ns is not None
        _write(place / "times.txt", "\n".join(f"{stamp / 1e9:e}" for stamp in drive.timestamps_ns))
        _write(place / "calib.txt", _calibration(drive))

    def images(self, index: int) -> dict[str, NDArray[Any]]:
        frame = self._drive.frame(index)
        found = (frame.left, frame.right, frame.color)
        return {
            self._path(name, index): image
            for name, image in zip(self._names, found, strict=False)
            if image is not None
        }

    def last(self, index: int) -> str:
        return self._path(self._names[-1], index)

    def _path(self, name: str, index: int) -> str:
        return f"sequences/{self._number}/{name}/{index:06d}.png"


class _CorbsFiles:
    def __init__(self, world: Synthetic) -> None:
        if world.sensor != "tof":
            raise DatasetError(f"{world.name} can be recorded as tof or as a drive, not as {world.sensor}")
        self._world = world
        assert world.timestamps_ns is not None
        self._stamps = [_EPOCH_NS + int(stamp) for stamp in world.timestamps_ns]

    def fingerprint(self) -> str:
        world, digest = self._world, hashlib.sha256()
        for index in range(len(world)):
            digest.update(world.pose(index).tobytes())
        for index in sorted({0, len(world) // 2, len(world) - 1}):
            for image in self.images(index).values():
                digest.update(image.tobytes())
        return digest.hexdigest()

    def begin(self, root: Path) -> None:
        world, place = self._world, root / CORBS
        for kind in ("rgb", "depth"):
            (place / kind).mkdir(parents=True, exist_ok=True)
            lines = [f"{_seconds(stamp)} {kind}/{_seconds(stamp)}.png" for stamp in self._stamps]
            _write(place / f"{kind}.txt", "\n".join(lines))
        K = world.camera.intrinsics
        matrix = ((K.fx, 0.0, K.cx), (0.0, K.fy, K.cy), (0.0, 0.0, 1.0))
        _write(place / "camera-intrinsics.txt", "\n".join(" ".join(map(str, row)) for row in matrix))
        write_tum(place / "groundtruth.txt", self._stamps, [world.pose(i) for i in range(len(world))])

    def images(self, index: int) -> dict[str, NDArray[Any]]:
        frame, name = self._world.frame(index), f"{_seconds(self._stamps[index])}.png"
        assert frame.depth is not None
        assert frame.color is not None
        depth = np.rint(frame.depth * (DEPTH_SCALE * _PER_METRE)).astype(np.uint16)
        return {f"{CORBS}/rgb/{name}": frame.color, f"{CORBS}/depth/{name}": depth}

    def last(self, index: int) -> str:
        return f"{CORBS}/depth/{_seconds(self._stamps[index])}.png"


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9 // 1000:06d}"


def _calibration(drive: StreetDrive) -> str:
    """calib.txt: the colour camera is the left one, and the Velodyne stands at it."""
    K, lines = drive.intrinsics, []
    for name, shift in (("P0", 0.0), ("P1", -drive.baseline_fx), ("P2", 0.0), ("P3", -drive.baseline_fx)):
        P = (K.fx, 0, K.cx, shift, 0, K.fy, K.cy, 0, 0, 0, 1, 0)
        lines.append(f"{name}: " + " ".join(f"{value:.12e}" for value in P))
    axes = (0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0)
    return "\n".join([*lines, "Tr: " + " ".join(f"{value:.12e}" for value in axes)])


def _read_about(folder: Path) -> dict[str, Any] | None:
    try:
        found: dict[str, Any] = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found


def _write(path: Path, text: str) -> None:
    with replacing(path) as file:
        file.write(text.encode() + b"\n")


def _write_image(path: Path, image: NDArray[Any]) -> None:
    done, coded = cv2.imencode(".png", image, _PNG)
    if not done:
        raise DatasetError(f"cannot encode {path.name}")
    with replacing(path) as file:
        file.write(coded.tobytes())
