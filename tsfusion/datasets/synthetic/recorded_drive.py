# SPDX-License-Identifier: MIT
"""A street drive rendered once and kept as files in the layout of KITTI's odometry benchmark.

The folder appears when it is whole. Until then the pictures lie beside it, and the next call goes on there.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.durable_files import make_folder, replacing, sync_folder
from tsfusion.core.errors import DatasetError
from tsfusion.core.folder_lock import hold
from tsfusion.datasets.synthetic.street_drive import StreetDrive

ABOUT = "world.json"
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # noise does not compress: more effort saves 3 %


def record(
    drive: StreetDrive,
    folder: Path,
    *,
    color: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a drive into a folder that `open_dataset` and pykitti read; at once where it is there already.

    Args:
        folder: of the benchmark: `sequences/NN` with calib.txt, times.txt and images, `poses/NN.txt`.
        color: write the left camera's colour images (`image_2`) too; half as much again on the disk.
        progress: called with the number of frames that are done, and of all.

    Raises:
        DatasetError: another drive is there, another process renders it, or the disk refuses.
    """
    about = {"world": drive.name, "frames": len(drive), "color": color, "fingerprint": drive.fingerprint()}
    folder = folder.absolute()
    if folder.exists():
        if _read_about(folder) != about:
            raise DatasetError(f"{folder} holds something else than {drive.name}; choose another folder")
        return
    partial = folder.with_name(f".{folder.name}.partial")
    try:
        make_folder(folder.parent)
        with hold(folder.parent, f".{folder.name}.lock"):
            _render(drive, partial, about, progress)
            os.replace(partial, folder)
            sync_folder(folder.parent)
        (folder.parent / f".{folder.name}.lock").unlink(missing_ok=True)
    except BlockingIOError as error:
        raise DatasetError(f"another process renders {folder}; wait until it has finished") from error
    except OSError as error:
        raise DatasetError(f"cannot write {folder}: {error.strerror}; choose another folder") from error


def _render(
    drive: StreetDrive, partial: Path, about: dict[str, Any], progress: Callable[[int, int], None] | None
) -> None:
    if partial.exists() and _read_about(partial) != about:
        shutil.rmtree(partial)
    number = drive.drive.sequence
    place = partial / "sequences" / number
    for name in ("image_0", "image_1", "image_2")[: 2 + about["color"]]:
        (place / name).mkdir(parents=True, exist_ok=True)
    (partial / "poses").mkdir(exist_ok=True)
    _write(partial / ABOUT, json.dumps(about, indent=1))
    lines = drive.poses_file.read_text(encoding="utf-8").splitlines()[: len(drive)]
    _write(partial / "poses" / f"{number}.txt", "\n".join(lines))
    assert drive.timestamps_ns is not None
    _write(place / "times.txt", "\n".join(f"{stamp / 1e9:e}" for stamp in drive.timestamps_ns))
    _write(place / "calib.txt", _calibration(drive))
    for index in range(len(drive)):
        last = place / ("image_2" if about["color"] else "image_1") / f"{index:06d}.png"
        if not last.exists():
            frame = drive.frame(index)
            for name, image in zip(
                ("image_0", "image_1", "image_2")[: 2 + about["color"]],
                (frame.left, frame.right, frame.color),
                strict=False,
            ):
                assert image is not None
                _write_image(place / name / f"{index:06d}.png", image)
        if progress is not None:
            progress(index + 1, len(drive))


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


def _write_image(path: Path, image: NDArray[np.uint8]) -> None:
    done, coded = cv2.imencode(".png", image, _PNG)
    if not done:
        raise DatasetError(f"cannot encode {path.name}")
    with replacing(path) as file:
        file.write(coded.tobytes())
