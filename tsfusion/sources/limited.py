# SPDX-License-Identifier: MIT
"""The first frames of a source."""

from collections.abc import Iterator
from itertools import islice
from types import TracebackType

from tsfusion.frame import Frame
from tsfusion.sources.base import Source


class Limited:
    """At most `limit` frames of a source, which is closed with it."""

    def __init__(self, source: Source, limit: int) -> None:
        self.name, self.sensor, self.skipped = source.name, source.sensor, source.skipped
        self.live = source.live
        self.length = None if source.length is None else min(source.length, limit)
        self._source, self._limit = source, limit

    def __iter__(self) -> Iterator[Frame]:
        """Its frames, as they come."""
        return islice(iter(self._source), self._limit)

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def __enter__(self) -> "Limited":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
