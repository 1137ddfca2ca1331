# SPDX-License-Identifier: MIT
"""Questions to a map whose numbers are at the edge of what numbers can say."""

import random
from typing import Any, get_args

import numpy as np

from tsfusion.core.config import Surface
from tsfusion.geometry import map_questions, se3
from tsfusion.geometry.map_questions import Field, Raycast, Sample, Slice
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.questions import Cells, Keyframes, Question, Scans

EDGES = (0.0, -0.0, 1e-320, 1e-300, 1e-30, 1e-9, 0.04, 1.0, -1.0, 1e3, 1e6, 1e19, 1e39, 1e155, 1e300, -1e300)
_LARGE = (0, 1, -1, 1 << 20, -(1 << 20), 1 << 31, -(1 << 31), (1 << 63) - 1, -(1 << 63))


def drawn(rng: random.Random) -> tuple[Question, list[Any]]:
    """A question, and the frames of its points."""

    def odd() -> float:
        return rng.choice(EDGES) if rng.random() < 0.3 else rng.uniform(-2, 2)

    def several(n: int) -> tuple[Any, ...]:
        return tuple(odd() for _ in range(n))

    how: dict[str, Any] = {"min_weight": rng.choice((None, 0.0, 1.0, odd()))}
    surface: Any = rng.choice((None, *get_args(Surface)))
    kind = rng.randrange(6)
    if kind == 0:
        with np.errstate(over="ignore"):
            points = np.array([several(3) for _ in range(rng.randrange(1, 40))]).astype(np.float32)
        frames = questions.point_frames(points)
        return Sample(len(points), map_questions.crc_of(frames), surface=surface, **how), frames
    if kind == 1:
        T = se3.exp(np.array([rng.gauss(0, 1) for _ in range(6)]))
        T[:3, 3] = several(3)
        shape = rng.choice((1, 48, 200)), rng.choice((1, 64, 300))
        return Raycast(several(4), tuple(T.ravel().tolist()), shape, surface=surface, **how), []
    if kind == 2:
        box: Any = rng.choice((None, several(4), (-1.0, -1.0, 2.0, 2.0)))
        low, high = (several(2), (-0.5, 0.5))[rng.randrange(2)]
        resolution = rng.choice((None, 0.05, odd()))
        which = rng.choice(("occupancy", "distance"))
        return Slice(which, low, high, several(3), box, resolution, rng.choice((0.5, odd())), **how), []
    if kind == 3:
        return Field(rng.choice((several(6), (-1.0, -1.0, 0.0, 1.0, 1.0, 2.0))), odd(), **how), []
    if kind == 4:
        follows = rng.choice((Cells, Scans))
        return follows(rng.choice(_LARGE), "", rng.choice((0.0, 1.0, odd())), rng.choice(_LARGE)), []
    return Keyframes(rng.randbytes(rng.choice((0, 1, 16))), rng.choice(_LARGE)), []
