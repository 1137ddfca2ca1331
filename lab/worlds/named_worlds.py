# SPDX-License-Identifier: MIT
"""The laboratory's worlds by name: `synthetic:kitti06`, `synthetic:kitti07` and `synthetic:desk`.

`pip install -e lab` in a clone tells every command of them: its entry points name the layouts here.
"""

from pathlib import Path
from typing import Any

from lab.worlds.desk_world import Desk
from lab.worlds.street_drive import DRIVES, StreetDrive
from tsfusion.datasets import Dataset, Layout, open_dataset
from tsfusion.datasets.layout_registry import open_as

_NAMES = tuple(f"synthetic:{name}" for name in DRIVES)

DRIVE = Layout(
    "KITTI's paths",
    f"no files: {', '.join(_NAMES)}: stereo pairs through a rendered street, with --option kitti=FOLDER, "
    "which holds KITTI's poses",
    lambda path: str(path) in _NAMES,
    StreetDrive,
)
DESK = Layout(
    "desk",
    "no files: synthetic:desk, or synthetic:desk:SENSOR, filmed by hand; usually tof",
    lambda path: str(path) == "synthetic:desk",
    Desk,
)


def open_world(source: str, **options: Any) -> Dataset:
    """Open what `open_dataset` opens where the laboratory is installed.

    Raises:
        DatasetError: as `open_dataset`.
    """
    world, _, sensor = source.removeprefix("synthetic:").partition(":")
    given = {"world": world, "sensor": sensor or None, **options}
    for layout in (DRIVE, DESK):
        if layout.recognises(Path(f"synthetic:{world}")):
            return open_as(layout.name, layout.open, given)
    return open_dataset(source, **options)
