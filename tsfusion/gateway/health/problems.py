# SPDX-License-Identifier: MIT
"""Problems as a person would name them: one plain line each, and since when each is there."""

import logging
import re
import time
from collections.abc import Callable, Iterable

from msgspec import Struct

from tsfusion.core import logs
from tsfusion.core.readable_numbers import span

log = logging.getLogger(__name__)


class Problem(Struct, frozen=True):
    """Something that is wrong now, and what to do about it.

    Attributes:
        text: without the map's and the client's name.
        map: that it is about; empty = the whole server.
        client: a client and its session, in words; empty = it is no single client's.
        is_logged: whether who found it logs its begin and its end.
    """

    text: str
    map: str = ""
    client: str = ""
    is_logged: bool = False

    @property
    def key(self) -> tuple[str, str, str]:
        """Name of the problem while it lasts: figures in its words may change."""
        return self.map, self.client, re.sub(r"[0-9]+", "#", self.text)

    @property
    def words(self) -> str:
        """The problem, with the client that it is about."""
        return f"{self.client}: {self.text}" if self.client else self.text

    @property
    def line(self) -> str:
        """The problem, with the map and the client that it is about."""
        return f"map {self.map}: {self.words}" if self.map else self.words


class ProblemTimes:
    """Since when each problem is there; a line in the log when one begins, and when it ends."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began: dict[tuple[str, str, str], tuple[Problem, float]] = {}

    def note(self, problems: Iterable[Problem]) -> None:
        """Log what began and what ended. Call it about once a second."""
        now = self._clock()
        present = {one.key: one for one in problems}
        for key in self._began.keys() - present.keys():
            ended, since = self._began.pop(key)
            if not ended.is_logged:
                after, about = span(now - since), logs.about(map=ended.map)
                log.info("no longer a problem, after %s: %s", after, ended.words, extra=about)
        for key, one in present.items():
            if key not in self._began and not one.is_logged:
                log.warning("problem: %s", one.words, extra=logs.about(map=one.map))
            self._began[key] = (one, self._began[key][1] if key in self._began else now)

    def lines(self, problems: Iterable[Problem]) -> tuple[str, ...]:
        """The problems in words, each with how long it has been there."""
        now = self._clock()
        return tuple(f"{one.line} (for {span(now - self._since(one, now))})" for one in problems)

    def _since(self, problem: Problem, now: float) -> float:
        return self._began.get(problem.key, (problem, now))[1]
