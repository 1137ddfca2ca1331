# SPDX-License-Identifier: MIT
"""Describe problems in plain words: one line for each, with the time that it has lasted."""

import logging
import re
import time
from collections.abc import Callable, Iterable

from msgspec import Struct

from tsfusion.core import logs
from tsfusion.core.readable_numbers import span

log = logging.getLogger(__name__)


class Problem(Struct, frozen=True):
    """Fault of the server, a map or a client at present, and what to do about it.

    Attributes:
        text: without the names of map and client.
        map: map with the problem; empty for the whole server.
        client: a client and its session, in words; empty if the problem is not about one client.
        is_logged: True if the finder logs its start and end.
    """

    text: str
    map: str = ""
    client: str = ""
    is_logged: bool = False

    @property
    def key(self) -> tuple[str, str, str]:
        """Key of the problem while it lasts: map, client, and the text without its numbers."""
        return self.map, self.client, re.sub(r"[0-9]+", "#", self.text)

    @property
    def words(self) -> str:
        """Text of the problem after the name of its client."""
        return f"{self.client}: {self.text}" if self.client else self.text

    @property
    def line(self) -> str:
        """Text of the problem after the names of its map and client."""
        return f"map {self.map}: {self.words}" if self.map else self.words


class ProblemTimes:
    """Times at which present problems began; logs the start and the end of each."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began: dict[tuple[str, str, str], tuple[Problem, float]] = {}

    def note(self, problems: Iterable[Problem]) -> None:
        """Compare with the last call: log new problems, and those that ended. Call it once a second."""
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
        """Return the problems in words, each with its duration."""
        now = self._clock()
        return tuple(f"{one.line} (for {span(now - self._since(one, now))})" for one in problems)

    def _since(self, problem: Problem, now: float) -> float:
        return self._began.get(problem.key, (problem, now))[1]
