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
    │   │   └── MapQuota                   its sender has had its share of the map's room
    │   ├── WeightOverflow                 a voxel has taken as many votes as its integers hold
    │   └── CheckpointError                a saved map is missing, unreadable or of another version
    │       └── DamagedCheckpoint          its bytes are not those that were written
    ├── AlignmentRefused                   nobody can tell where one map lies in another
    ├── TransportError
    │   ├── ServerUnreachable              nobody answered on the control socket in time
    │   ├── AnswerLate                     the map on a server did not answer a question in time
    │   ├── NotAllowed                     the server turned this client's keys away, or its lack of them
    │   ├── WorldRefused                   the map has keyframes of another coordinate frame
    │   ├── FlushTimeout                   keyframes were still unacknowledged at the deadline
    │   └── KeyframeRefused                the server will never take this keyframe, and said why
    ├── WorkerLost                         one worker after the other ended at the same job
    ├── OutputError                        a result cannot be written
    ├── IncompleteRun                      a run has left its results, but missed what it was for
    └── MissingDependency                  an optional package is needed; the message names the command

The command line prints any of these as one line and exits with status 1.
"""

from errno import ENOENT, ENOTDIR, ESTALE

MISSING = (ENOENT, ENOTDIR, ESTALE)  # answers of a system that does not find a file or its folder


class TsfusionError(Exception):
    """Base of all errors raised on purpose."""


class InvalidKeyframe(TsfusionError, ValueError):
    """A keyframe's field is not what it must be: the message names field, value and expectation."""


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
        errno: why the operating system refused; None = it did not, the journal itself is wrong.
        is_erased: whether the record that was to be read was erased on purpose.
    """

    def __init__(self, message: str, errno: int | None = None, *, is_erased: bool = False) -> None:
        super().__init__(message)
        self.errno = errno
        self.is_erased = is_erased

    @property
    def temporary(self) -> bool:
        """True if a record may be readable later: the system refused to read it now, or did not find it."""
        return self.errno is not None


class MapError(TsfusionError):
    """The map cannot do what was asked."""


class MapFull(MapError):
    """A keyframe needs more blocks than the limits allow; the map is as it was before."""


class KeyframeTooLarge(MapFull):
    """A keyframe touches more blocks, or its rays cost more time, than the limits allow any keyframe."""


class MapQuota(MapFull):
    """A keyframe needs more blocks than are left of its sender's share of the map's room."""


class WeightOverflow(MapError):
    """A voxel has taken as many votes as its integers hold; the map is as it was before."""


class CheckpointError(MapError):
    """A saved map is missing, unreadable or of another version.

    Attributes:
        missing: whether there is no such file.
    """

    def __init__(self, message: str, *, missing: bool = False) -> None:
        super().__init__(message)
        self.missing = missing


class DamagedCheckpoint(CheckpointError):
    """A saved map is cut short, altered or malformed: its bytes are not those that were written."""


class AlignmentRefused(TsfusionError):
    """Two maps share too little, or too much looks alike, to say where one lies in the other."""


class TransportError(TsfusionError):
    """The link between scanner and server failed."""


class ServerUnreachable(TransportError):
    """Nobody answered on the control socket in time."""


class AnswerLate(TransportError):
    """The map on a server did not answer a question before the deadline: the server is there, and busy."""


class NotAllowed(TransportError):
    """The server turned this client's keys away, or its lack of them; the message says what to do."""


class WorldRefused(TransportError):
    """The map has keyframes of another coordinate frame; this client's stay in its spool."""


class FlushTimeout(TransportError):
    """Keyframes were still unacknowledged at the deadline (they stay in the spool)."""


class KeyframeRefused(TransportError):
    """The server will never take this keyframe, and said why; or the spool could not keep it."""


class WorkerLost(TsfusionError):
    """One worker after the other ended at the same job: nobody can do it."""


class OutputError(TsfusionError):
    """A result cannot be written."""


class IncompleteRun(TsfusionError):
    """A run has left its results, but missed what it was for; the message says what to do."""


class MissingDependency(TsfusionError):
    """An optional package is needed; the message names the command that installs it."""
