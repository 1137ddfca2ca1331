# SPDX-License-Identifier: MIT
"""Recorded and synthetic datasets: sequences of keyframes, loaded one at a time.

Any object with `__len__` and `__getitem__` that follows the `Dataset` protocol can be replayed.
"""

import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from tsfusion.datasets import bags, kitti, rgbd_folders, sevenscenes, tum
from tsfusion.datasets.base import Dataset, Selection, select
from tsfusion.datasets.kitti import KITTI
from tsfusion.datasets.rgbd_folders import HoloLens, Redwood
from tsfusion.datasets.sevenscenes import SevenScenes
from tsfusion.datasets.synthetic import Synthetic
from tsfusion.datasets.tum import TUM
from tsfusion.errors import DatasetError

__all__ = [
    "KITTI",
    "LAYOUTS",
    "TUM",
    "Dataset",
    "HoloLens",
    "Redwood",
    "Selection",
    "SevenScenes",
    "Synthetic",
    "open_dataset",
    "select",
]


class _Layout(NamedTuple):
    name: str
    description: str
    recognises: Callable[[Path], bool]
    open: Callable[..., Dataset]


_LAYOUTS = (
    _Layout("7-Scenes", sevenscenes.EXPECTED, sevenscenes.recognises, SevenScenes),
    _Layout("HoloLens", rgbd_folders.HOLOLENS_EXPECTED, rgbd_folders.recognises_hololens, HoloLens),
    _Layout("Redwood", rgbd_folders.REDWOOD_EXPECTED, rgbd_folders.recognises_redwood, Redwood),
    _Layout("TUM RGB-D", tum.EXPECTED + " (also CoRBS, ICL-NUIM)", tum.recognises, TUM),
    _Layout("KITTI odometry", kitti.EXPECTED, kitti.recognises, kitti.open_kitti),
    _Layout("ROS bag", bags.EXPECTED, bags.recognises, bags.Bag),
)
_SYNTHETIC = "synthetic:"

LAYOUTS: tuple[tuple[str, str], ...] = (
    *((layout.name, layout.description) for layout in _LAYOUTS),
    ("synthetic", "no files: synthetic:room or synthetic:street, then :kinect, :stereo or :lidar"),
)


def open_dataset(path: str | Path, **options: Any) -> Dataset:
    """Recognise a folder's layout and open it.

    Args:
        path: a folder in one of `LAYOUTS`, or a folder that holds exactly one; or `synthetic:WORLD:SENSOR`.
        options: passed to the layout's class (`sequence=`, `modality=`, `poses=` for KITTI, `trajectory=`
            for TUM, `count=`, `seed=` for synthetic worlds, …); those that are None are left out.

    Raises:
        DatasetError: naming what was found wrong or, for an unknown layout, what would have been recognised.
    """
    options = {key: value for key, value in options.items() if value is not None}
    if str(path).startswith(_SYNTHETIC):
        words = str(path)[len(_SYNTHETIC) :].split(":")
        if len(words) > 2:
            raise DatasetError(f"{path!s}: expected synthetic:WORLD or synthetic:WORLD:SENSOR")
        given = dict(zip(("world", "sensor"), filter(None, words), strict=False))
        return _open("synthetic", Synthetic, (), {**given, **options})
    root = Path(path).expanduser()
    if not root.is_dir() and not bags.recognises(root):
        state = "is not a folder" if root.exists() else "does not exist"
        raise DatasetError(f"{root} {state}; expected a dataset folder or synthetic:room, synthetic:street")
    found = _recognise([root]) or _recognise(_folders_in(root))
    if len(found) != 1:
        raise DatasetError(_unrecognised(root, [child for child, _ in found]))
    place, layout = found[0]
    return _open(layout.name, layout.open, (place,), options)


def _folders_in(root: Path) -> list[Path]:
    try:
        return sorted(child for child in root.iterdir() if child.is_dir())
    except OSError as error:
        raise DatasetError(f"cannot read {root}: {error.strerror}") from error


def _recognise(folders: Iterable[Path]) -> list[tuple[Path, _Layout]]:
    matches = (
        (place, next((layout for layout in _LAYOUTS if layout.recognises(place)), None)) for place in folders
    )
    return [(place, layout) for place, layout in matches if layout is not None]


def _unrecognised(root: Path, several: list[Path]) -> str:
    if several:
        return f"{root} holds {len(several)} datasets; open one of them: {', '.join(map(str, several))}"
    known = "; ".join(f"{name}: {description}" for name, description in LAYOUTS)
    return f"{root} is in no layout known here. Expected one of: {known}"


def _open(
    name: str, opener: Callable[..., Dataset], places: tuple[Path, ...], options: dict[str, Any]
) -> Dataset:
    known = [key for key in inspect.signature(opener).parameters if key not in ("path", "root")]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise DatasetError(f"a {name} dataset takes no `{unknown[0]}`")
    return opener(*places, **options)
