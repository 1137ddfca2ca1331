# SPDX-License-Identifier: MIT
"""tsfusion: depth sensors in, one exact 3-D map out.

Names are loaded on first use, so that a scanner which needs only `Client` and `Keyframe` never
imports Taichi.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsfusion.client import Client as Client
    from tsfusion.config import Config as Config
    from tsfusion.config import VolumeConfig as VolumeConfig
    from tsfusion.datasets import open_dataset as open_dataset
    from tsfusion.errors import CheckpointError as CheckpointError
    from tsfusion.errors import DamagedCheckpoint as DamagedCheckpoint
    from tsfusion.errors import DatasetError as DatasetError
    from tsfusion.errors import DecodeError as DecodeError
    from tsfusion.errors import FlushTimeout as FlushTimeout
    from tsfusion.errors import InvalidConfig as InvalidConfig
    from tsfusion.errors import InvalidKeyframe as InvalidKeyframe
    from tsfusion.errors import JournalError as JournalError
    from tsfusion.errors import KeyframeRefused as KeyframeRefused
    from tsfusion.errors import MapError as MapError
    from tsfusion.errors import MapFull as MapFull
    from tsfusion.errors import MissingDependency as MissingDependency
    from tsfusion.errors import NotAllowed as NotAllowed
    from tsfusion.errors import OutputError as OutputError
    from tsfusion.errors import ServerUnreachable as ServerUnreachable
    from tsfusion.errors import SourceError as SourceError
    from tsfusion.errors import TransportError as TransportError
    from tsfusion.errors import TsfusionError as TsfusionError
    from tsfusion.errors import WeightOverflow as WeightOverflow
    from tsfusion.keyframe import Intrinsics as Intrinsics
    from tsfusion.keyframe import Keyframe as Keyframe
    from tsfusion.mesh import Mesh as Mesh
    from tsfusion.volume import Volume as Volume

__version__ = "0.1.0"

_ERRORS = (
    "CheckpointError", "DamagedCheckpoint", "DatasetError", "DecodeError", "FlushTimeout", "InvalidConfig",
    "InvalidKeyframe", "JournalError", "KeyframeRefused", "MapError", "MapFull", "MissingDependency",
    "NotAllowed", "OutputError", "ServerUnreachable", "SourceError",
    "TransportError", "TsfusionError", "WeightOverflow",
)  # fmt: skip
_HOME = {
    "Client": "client",
    "Config": "config",
    "Intrinsics": "keyframe",
    "Keyframe": "keyframe",
    "Mesh": "mesh",
    "Volume": "volume",
    "VolumeConfig": "config",
    "open_dataset": "datasets",
    **dict.fromkeys(_ERRORS, "errors"),
}
__all__ = ["__version__", *_HOME]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"tsfusion.{_HOME[name]}"), name)
    raise AttributeError(f"module 'tsfusion' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
