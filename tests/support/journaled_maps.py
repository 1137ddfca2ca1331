# SPDX-License-Identifier: MIT
"""Folders of maps with journals, as a server leaves them, and unknown starts."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from tsfusion import Keyframe, Volume, VolumeConfig
from tsfusion.geometry import se3
from tsfusion.journal import Journal, state_folder
from tsfusion.wire.records import codec


def recorded(folder: Path, keyframes: Iterable[Keyframe], config: VolumeConfig) -> Path:
    """A map's folder with these keyframes in its journal, and these settings."""
    session = folder.name.encode().ljust(16, b"\0")[:16]
    journal = Journal(folder / state_folder.JOURNAL_FOLDER, 1 << 28)
    for seq, keyframe in enumerate(keyframes, 1):
        encode = partial(codec.encode, keyframe, jpeg_quality=90)
        journal.append(encode(session=session, seq=seq), session=session, seq=seq)
    journal.close()
    Volume(config).save(folder / state_folder.MAP_FILE, meta={"done": {}, "rejected": {}})
    return folder


def unknown_start(seed: int) -> np.ndarray:
    """A transform of up to 3 m, by any angle about any axis."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    turn = axis / np.linalg.norm(axis) * random.uniform(0.5, np.pi)
    return se3.exp(np.concatenate([random.uniform(-3, 3, 3), turn]))
