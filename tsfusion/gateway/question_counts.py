# SPDX-License-Identifier: MIT
"""Questions that a map was asked, what became of them, and how long the answers took."""

from collections import Counter, deque
from typing import Literal

import numpy as np

from tsfusion.wire import keyframe_times
from tsfusion.wire.keyframe_times import Spread

_NEWEST = 1024  # answers, whose delays count
# refused: not passed on to the fuser; late: their time was over; failed: the fuser could not
Outcome = Literal["answered", "refused", "late", "failed"]


class QuestionCounts:
    """The figures of one map."""

    def __init__(self) -> None:
        self.by_outcome: Counter[str] = Counter()
        self._delays_ms: deque[float] = deque(maxlen=_NEWEST)

    def add(self, outcome: Outcome, seconds: float | None = None) -> None:
        """Count a question; with the seconds that its answer took."""
        self.by_outcome[outcome] += 1
        if seconds is not None:
            self._delays_ms.append(1e3 * seconds)

    @property
    def delay_ms(self) -> Spread:
        """From when the newest questions came to when their answers left, milliseconds."""
        return keyframe_times.spread(np.array(self._delays_ms))
