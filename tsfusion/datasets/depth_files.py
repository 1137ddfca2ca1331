# SPDX-License-Identifier: MIT
"""Depth images from files: 16-bit PNG, TIFF or PGM, and floats in TIFF, EXR or NPY."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import read_limits
from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets.readers import read_image
from tsfusion.geometry.sample_ranges import FARTHEST_M, NEAREST_M

SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".exr", ".npy")
_EVERY = 4  # pixels, looked at for the unit; rows, for the order of bytes
_FEWEST_STEPS = 200  # between neighbours, that tell the order of bytes
_SMOOTHER = 8  # times; depth the right way round is 10 to 100 times smoother


def read_depth(path: Path, *, invalid: int | None = None) -> NDArray[Any]:
    """(H, W) depth: uint16 in the recording's units, with 0 for `invalid`, or float32 as stored.

    Raises:
        DatasetError: no such file, or not one channel of 16 bits or floats.
        MissingDependency: for EXR without the OpenEXR package.
    """
    depth = _stored(path)
    depth = depth.astype(depth.dtype.newbyteorder("="), copy=False)
    if (
        depth.ndim == 3
        and (depth.shape[2] == 1 or depth.dtype.kind == "f")
        and (depth == depth[:, :, :1]).all()
    ):
        depth = depth[:, :, 0]  # grey, as floats are often written
    if depth.dtype.kind in "iu" and depth.dtype.itemsize > 2 and (depth == depth.astype(np.uint16)).all():
        depth = depth.astype(np.uint16)
    if depth.ndim != 2 or depth.dtype not in (np.uint16, np.float16, np.float32, np.float64):
        raise DatasetError(f"{path} must hold one 16-bit channel or floats, got {_described(depth)}")
    if depth.dtype != np.uint16:
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(depth, dtype=np.float32)
    if invalid is not None:
        depth[depth == invalid] = 0
    return np.ascontiguousarray(depth, dtype=np.uint16)


def check_metres(depth: NDArray[np.float32], source: object) -> None:
    """Raise DatasetError where floats are evidently not metres: half are beyond 100 m, or within 1 cm."""
    some = depth[::_EVERY, ::_EVERY]
    valid = some[np.isfinite(some) & (some > 0)]
    middle = float(np.median(valid)) if valid.size else 1.0
    if NEAREST_M <= middle <= FARTHEST_M:
        return
    unit, scale = ("millimetres", "0.001") if middle > FARTHEST_M else ("divided once too often", "1")
    raise DatasetError(
        f"{source}: depth is expected in metres, but the median of its floats is {middle:.5g}: {unit}? "
        f"then give --option depth_scale={scale} (in Python depth_scale={scale})"
    )


def check_byte_order(depth: NDArray[Any], source: object) -> None:
    """Raise DatasetError where (H, W) uint16 depth is far smoother with its numbers' bytes exchanged."""
    if depth.dtype != np.uint16 or not (depth & 0xFF).any():  # others are what they are
        return
    rows = depth[::_EVERY]
    both = (rows[:, 1:] > 0) & (rows[:, :-1] > 0)
    if np.count_nonzero(both) < _FEWEST_STEPS:
        return
    steps, exchanged = (
        np.abs(np.diff(image.astype(np.int32), axis=1))[both].mean() for image in (rows, rows.byteswap())
    )
    if steps > _SMOOTHER * exchanged:
        raise DatasetError(
            f"{source}: the two bytes of each depth value are exchanged (neighbours differ by {steps:.0f}, "
            f"after exchanging them by {exchanged:.0f}): write the depth anew in the PNG's own byte order, "
            "big-endian (numpy's `byteswap()` mends what was read)"
        )


def read_npy(path: Path) -> NDArray[Any]:
    """The array of a `.npy` file; raises DatasetError."""
    try:  # its size is compared with what is there
        found = np.lib.format.open_memmap(path, mode="r")
        read_limits.check(path, found.nbytes)
        return np.array(found)
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; expected an (H, W) array of depth") from error
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read; expected an (H, W) array of depth ({error})") from error


def _stored(path: Path) -> NDArray[Any]:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_npy(path)
    return _read_exr(path) if suffix == ".exr" else read_image(path, "a depth image")


def _read_exr(path: Path) -> NDArray[Any]:
    """The only channel, or equal ones stacked; OpenCV's wheels come without OpenEXR."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; expected a depth image")
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingDependency(f"{path}: to read EXR: pip install '.[exr]'") from error
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            for part in file.parts:
                low, high = part.header["dataWindow"]
                pixels = np.prod(np.subtract(high, low, dtype=float) + 1)
                read_limits.check(path, 4 * len(part.header["channels"]) * pixels)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = [channel.pixels for name, channel in file.channels().items() if name != "A"]
        return channels[0] if len(channels) == 1 else np.dstack(channels)
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise DatasetError(f"{path} cannot be decoded; expected a depth image ({error})") from error


def _described(image: NDArray[Any]) -> str:
    """Description of a file's content in place of depth."""
    shape = f"shape {image.shape} of {image.dtype}"
    if image.ndim == 3 and image.dtype == np.uint8:
        return f"{shape}: a colour image"
    return f"{shape} (was it saved again as 8 bits?)" if image.dtype == np.uint8 else shape
