# SPDX-License-Identifier: MIT
"""Take frames from a depth camera through its maker's library: waits, dropped frames, and why it stopped."""

import os
import sys
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from tsfusion.core.errors import MissingDependency, SourceError
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope, inertial_fields
from tsfusion.scanner.sources.source import LiveSource

ADVICE = "Close other programs that use it, or try another cable and USB 3 port"
MAX_REORDERED = 16  # exposures that a library may be working on
OLDEST_S = 1.0  # a frame that seems older has a timestamp of another clock
_WAIT_MS = 100  # between two checks whether the source was closed


class CameraSource(LiveSource):
    """Base class of cameras and their recordings.

    Args:
        deadline: seconds without a frame after which a camera counts as stopped; None = a recording.
    """

    failures: tuple[type[Exception], ...] = (RuntimeError,)  # all that the library raises
    baseline_fx: float | None = None
    _accelerometer, _gyroscope = Accelerometer(), Gyroscope()  # empty, for cameras without them

    def __init__(self, name: str, sensor: str, deadline: float | None) -> None:
        super().__init__(name, sensor)
        self._deadline, self._number = deadline, -MAX_REORDERED

    @abstractmethod
    def _wait(self, milliseconds: int) -> Any:
        """Wait for the images of the next exposure. Return None if there are none in time."""

    @abstractmethod
    def _frame(self, images: Any) -> Frame | None:
        """Return images as a frame; None if they are incomplete, or were seen before."""

    def _is_plugged_in(self) -> bool:
        """Return False if a camera is surely no longer there."""
        return True

    def _is_over(self) -> bool:
        """Return True if no images will follow those in the queue."""
        return False

    def __iter__(self) -> Iterator[Frame]:
        last = time.monotonic()
        while not self._closed.is_set():
            over = self._is_over()
            images = self._next()
            frame = None if images is None else self._frame(images)
            if frame is not None:
                yield frame
                last = time.monotonic()
            elif over and images is None:
                return
            elif self._deadline is not None and time.monotonic() - last > self._deadline:
                raise self._stopped(f"delivered no complete frames for {self._deadline:g} s")

    def _next(self) -> Any:
        try:
            return self._wait(_WAIT_MS)
        except self.failures as error:
            if self._closed.is_set():
                return None
            raise self._stopped(f"stopped: {error}") from error

    def _stopped(self, why: str) -> SourceError:
        if self._deadline is not None and not self._is_plugged_in():
            return SourceError(f"{self.name} was unplugged; plug it in and start again")
        return SourceError(f"{self.name} {why}. {ADVICE}")

    def _taken(self, stamps: tuple[int, int], moment_ns: int, **measured: Any) -> Frame:
        """Return a frame by its `timestamp_ns` and `captured_ns`, and its time for the inertial sensors."""
        return Frame(
            sensor=self.sensor, baseline_fx=self.baseline_fx, timestamp_ns=stamps[0], captured_ns=stamps[1],
            **inertial_fields(self._accelerometer, self._gyroscope, moment_ns), **measured,
        )  # fmt: skip

    def _is_new(self, number: int) -> bool:
        """Return False for an exposure that was seen before. Missing numbers count as dropped frames.

        A much smaller number comes from a camera that was restarted.
        """
        if 0 <= self._number - number < MAX_REORDERED:
            return False
        if 0 <= self._number < number - 1:
            self._skip("dropped", number - 1 - self._number)
        self._number = number
        return True


def chosen_camera(kind: str, serial: str | None, found: dict[str, Any], advice: str = "") -> Any:
    """Return the camera with a serial number, or the first one, of those found.

    Raises:
        SourceError: there is none.
    """
    if not found:
        raise SourceError(
            f"no {kind} camera found; expected one on a USB 3 port that no other program uses "
            f"({advice}on Linux its maker's udev rules let users open it)"
        )
    if serial is not None and serial not in found:
        raise SourceError(f"no {kind} camera {serial}; there is {', '.join(found)}")
    return found[serial or next(iter(found))]


@contextmanager
def _printed_to_stderr() -> Iterator[None]:
    """Send to stderr what native code prints to stdout."""
    sys.stdout.flush()
    usual = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(usual, 1)
        os.close(usual)


def camera_library(module: str, what: str, install: str, advice: str = "install it anew") -> Any:
    """Load the library of a camera's maker. What it prints goes to stderr.

    Raises:
        MissingDependency: it is not installed, or cannot be loaded.
    """
    try:
        with _printed_to_stderr():
            return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingDependency(f"{what} needs {module}; install it with: {install}") from error
    except ImportError as error:  # a shared library that the wheel does not bring along
        raise MissingDependency(
            f"{what} needs {module}, which is installed but cannot be loaded ({error}); {advice}"
        ) from error
