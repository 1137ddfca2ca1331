# SPDX-License-Identifier: MIT
"""What a source of frames is."""

from collections.abc import Iterator
from types import TracebackType
from typing import Protocol

from tsfusion.frame import Frame


class Source(Protocol):
    """Frames in time order: a sensor, a folder that is being written to, a recording.

    Attributes:
        name: what to call it in a report.
        sensor: name of the sensor model of its frames.
        live: whether frames pass by while nobody takes them; those of a recording or a folder wait.
        length: how many frames it has; None = nobody knows.
        skipped: frames that were not handed out, by reason, so far.
    """

    name: str
    sensor: str
    live: bool
    length: int | None
    skipped: dict[str, int]

    def __iter__(self) -> Iterator[Frame]:
        """Each frame as soon as it is there; ends when the source does.

        Raises:
            SourceError: the sensor stopped, with what to do about it.
        """

    def close(self) -> None:
        """Let go of the sensor; may be called twice, and from another thread to end the iteration."""

    def __enter__(self) -> "Source": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
