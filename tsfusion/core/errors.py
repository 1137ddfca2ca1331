# SPDX-License-Identifier: MIT
"""Every error tsfusion raises on purpose.

    TsfusionError
    ├── InvalidKeyframe      (ValueError)  a keyframe's field is not what it must be
    ├── InvalidConfig        (ValueError)  a setting is unknown, of the wrong type or out of range
    ├── DatasetError                       a recorded dataset is missing, empty or malformed
    ├── SourceError                        a live sensor cannot be opened, or stopped
    ├── DecodeError                        bytes from a socket or a journal are not a keyframe
    ├── JournalError                       the journal or spool cannot be read or written
    ├── MapError
    │   ├── MapFull                        a keyframe needs more blocks than the limits allow
    │   │   ├── KeyframeTooLarge           it needs more, or more time, than any keyframe may
    │   │   └── MapQuota                   its sender's quota in the map is used up
    │   ├── WeightOverflow                 a voxel has taken as many votes as its integers hold
    │   └── CheckpointError                a saved map is missing, unreadable or of another version
    │       └── DamagedCheckpoint          its bytes are not those that were written
    ├── AlignmentRefused                   the pose of one map in another is unclear
    ├── TransportError
    │   ├── ServerUnreachable              nobody answered on the control socket in time
    │   ├── AnswerLate                     the map on a server did not answer a question in time
    │   ├── NotAllowed                     the server refused this client's keys, or its lack of keys
    │   ├── WorldRefused                   the map has keyframes of another coordinate frame
    │   ├── FlushTimeout                   keyframes were still unacknowledged at the deadline
    │   └── KeyframeRefused                the server refused this keyframe for good, with a reason
    ├── WorkerLost                         several workers in turn died at the same job
    ├── OutputError                        a result cannot be written
    ├── IncompleteRun                      a run wrote its results but missed its goal
    └── MissingDependency                  an optional package is needed; the message names the command

The command line prints any of these as one line and exits with status 1.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from errno import EDQUOT, EFBIG, ENOENT, ENOSPC, ENOTDIR, ESTALE

# Error numbers
MISSING = (ENOENT, ENOTDIR, ESTALE)  # there is no such file or folder
DISK_FULL = (ENOSPC, EDQUOT, EFBIG)  # the disk, or what this user may have of it, has no more room


class TsfusionError(Exception):
    """Base of all errors raised on purpose."""


class InvalidKeyframe(TsfusionError, ValueError):
    """A keyframe's field is wrong: the message names the field, its value and the expected value."""


class InvalidConfig(TsfusionError, ValueError):
    """A setting is unknown, of the wrong type or out of range."""


class DatasetError(TsfusionError):
    """A recorded dataset is missing, empty or malformed."""


class SourceError(TsfusionError):
    """A live sensor cannot be opened, or stopped; the message says what to do."""


class DecodeError(TsfusionError):
    """Bytes from a socket or a journal are not a keyframe."""


class JournalError(TsfusionError):
    """The journal or spool cannot be read or written.

    Attributes:
        errno: error number of the operating system; None = the journal itself is wrong.
        is_erased: True if the requested record was erased on purpose.
    """

    def __init__(self, message: str, errno: int | None = None, *, is_erased: bool = False) -> None:
        super().__init__(message)
        self.errno = errno
        self.is_erased = is_erased

    @property
    def temporary(self) -> bool:
        """True if a retry may succeed: the system refused to read the record, or did not find it."""
        return self.errno is not None


class MapError(TsfusionError):
    """The map cannot do what was asked."""


class MapFull(MapError):
    """A keyframe needs more blocks than the limits allow; the map is unchanged."""


class KeyframeTooLarge(MapFull):
    """A keyframe touches more blocks, or costs more time, than limits allow; or its block hashes collide."""


class MapQuota(MapFull):
    """A keyframe needs more blocks than its sender's quota in the map has left."""


class WeightOverflow(MapError):
    """A voxel has taken as many votes as its integers can hold; the map is unchanged."""


class CheckpointError(MapError):
    """A saved map is missing, unreadable or of another version.

    Attributes:
        missing: True if the file does not exist.
    """

    def __init__(self, message: str, *, missing: bool = False) -> None:
        super().__init__(message)
        self.missing = missing


class DamagedCheckpoint(CheckpointError):
    """A saved map is cut short, altered or malformed: its bytes are not those that were written."""


class AlignmentRefused(TsfusionError):
    """The pose of one map in the other is unclear: they overlap too little, or too much looks alike."""


class TransportError(TsfusionError):
    """The link between scanner and server failed."""


class ServerUnreachable(TransportError):
    """Nobody answered on the control socket in time."""


class AnswerLate(TransportError):
    """The map on a server did not answer a question before the deadline: the server is there, and busy."""


class NotAllowed(TransportError):
    """The server refused this client's keys, or its lack of keys; the message says what to do."""


class WorldRefused(TransportError):
    """The map has keyframes of another coordinate frame; this client's keyframes stay in its spool."""


class FlushTimeout(TransportError):
    """Keyframes were still unacknowledged at the deadline (they stay in the spool)."""


class KeyframeRefused(TransportError):
    """The server refused this keyframe for good and gave the reason; or the spool could not store it."""


class WorkerLost(TsfusionError):
    """Several workers in turn died at the same job, so no worker can do it."""


class OutputError(TsfusionError):
    """A result cannot be written."""


class IncompleteRun(TsfusionError):
    """A run wrote its results but missed its goal; the message says what to do."""


class MissingDependency(TsfusionError):
    """An optional package is needed; the message names the command that installs it."""


def reason_of(error: OSError, advice: str = "") -> str:
    """Return `the system's reason; ADVICE`; a full disk has an advice of its own."""
    if error.errno in DISK_FULL:
        advice = "make room, or choose another place"
    return f"{error.strerror or error}{advice and '; '}{advice}"


@contextmanager
def refusals_as(kind: type[TsfusionError], what: str, advice: str = "") -> Iterator[None]:
    """Raise an OSError of the block as an error of tsfusion: `WHAT: the system's reason; ADVICE`."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {reason_of(error, advice)}") from error


@contextmanager
def errors_as(kind: type[TsfusionError], where: object, *caught: type[Exception]) -> Iterator[None]:
    """Raise errors of some kinds in the block as one of tsfusion: `WHERE: the error`."""
    try:
        yield
    except caught as error:
        raise kind(f"{where}: {error}") from error


@contextmanager
def needing(what: str) -> Iterator[None]:
    """Raise MissingDependency if the block's import fails; `what` needs it, and how it is installed."""
    try:
        yield
    except ImportError as error:
        raise MissingDependency(what) from error
