# SPDX-License-Identifier: MIT
"""tsfusion: depth sensors in, one exact 3-D map out. What people do with it:

    recording = tsfusion.open_dataset("recording")           read a recording, or "synthetic:room"
    volume = tsfusion.Volume(0.02, sensor="kinect")          begin a map of 2 cm voxels
    volume.integrate(recording[0])                           fuse a keyframe (tsfusion.Keyframe)
    volume.extract_mesh().save("room.ply")                   see its surface
    volume.distance_slice(0.1, 1.8)                          ask how far obstacles are
    volume.save("room.tsf"); tsfusion.Volume.load("room.tsf")    keep it
    tsfusion.Client("tcp://robot:5555").send(recording[0])   send keyframes to `tsfusion serve`

All names:

    Send     Client, Keyframe, Intrinsics
    Fuse     Volume, with the settings of VolumeConfig; Config is a whole file of settings
    Ask      MapClient, a map on a server, and Volume, one in this process; their answers are
             Samples, View, PointCloud, Blocks, DistanceField, DistanceSlice, OccupancySlice
             (both with a SliceGrid) and Mesh
    Read     open_dataset, a recording (Layout describes each kind); open_source, a sensor (a Source)
    Errors   TsfusionError and those below it: help(tsfusion.core.errors) draws them

Names are loaded on first use, so that a scanner which needs only `Client` and `Keyframe` never
imports Taichi.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tsfusion.client import Client as Client
    from tsfusion.core.config import Config as Config
    from tsfusion.core.config import VolumeConfig as VolumeConfig
    from tsfusion.core.errors import AlignmentRefused as AlignmentRefused
    from tsfusion.core.errors import AnswerLate as AnswerLate
    from tsfusion.core.errors import CheckpointError as CheckpointError
    from tsfusion.core.errors import DamagedCheckpoint as DamagedCheckpoint
    from tsfusion.core.errors import DatasetError as DatasetError
    from tsfusion.core.errors import DecodeError as DecodeError
    from tsfusion.core.errors import FlushTimeout as FlushTimeout
    from tsfusion.core.errors import IncompleteRun as IncompleteRun
    from tsfusion.core.errors import InvalidConfig as InvalidConfig
    from tsfusion.core.errors import InvalidKeyframe as InvalidKeyframe
    from tsfusion.core.errors import JournalError as JournalError
    from tsfusion.core.errors import KeyframeRefused as KeyframeRefused
    from tsfusion.core.errors import KeyframeTooLarge as KeyframeTooLarge
    from tsfusion.core.errors import MapError as MapError
    from tsfusion.core.errors import MapFull as MapFull
    from tsfusion.core.errors import MapQuota as MapQuota
    from tsfusion.core.errors import MissingDependency as MissingDependency
    from tsfusion.core.errors import NotAllowed as NotAllowed
    from tsfusion.core.errors import OutputError as OutputError
    from tsfusion.core.errors import ServerUnreachable as ServerUnreachable
    from tsfusion.core.errors import SourceError as SourceError
    from tsfusion.core.errors import TransportError as TransportError
    from tsfusion.core.errors import TsfusionError as TsfusionError
    from tsfusion.core.errors import WeightOverflow as WeightOverflow
    from tsfusion.core.errors import WorkerLost as WorkerLost
    from tsfusion.core.errors import WorldRefused as WorldRefused
    from tsfusion.datasets import Layout as Layout
    from tsfusion.datasets import open_dataset as open_dataset
    from tsfusion.geometry.keyframe import Intrinsics as Intrinsics
    from tsfusion.geometry.keyframe import Keyframe as Keyframe
    from tsfusion.geometry.map_answers import PointCloud as PointCloud
    from tsfusion.geometry.map_answers import Samples as Samples
    from tsfusion.geometry.map_answers import View as View
    from tsfusion.geometry.map_grids import DistanceField as DistanceField
    from tsfusion.geometry.map_grids import DistanceSlice as DistanceSlice
    from tsfusion.geometry.map_grids import OccupancySlice as OccupancySlice
    from tsfusion.geometry.map_grids import SliceGrid as SliceGrid
    from tsfusion.geometry.mesh import Mesh as Mesh
    from tsfusion.scanner.sources.source import Source as Source
    from tsfusion.scanner.sources.source import open_source as open_source
    from tsfusion.tsdf.files.voxel_arrays import Blocks as Blocks
    from tsfusion.tsdf.volume import Volume as Volume
    from tsfusion.wire.asking.map_client import MapClient as MapClient

__version__ = "0.1.0"

_ERRORS = (
    "AlignmentRefused", "AnswerLate", "CheckpointError", "DamagedCheckpoint", "DatasetError", "DecodeError",
    "FlushTimeout", "IncompleteRun", "InvalidConfig",
    "InvalidKeyframe", "JournalError", "KeyframeRefused", "KeyframeTooLarge", "MapError", "MapFull",
    "MapQuota", "MissingDependency",
    "NotAllowed", "OutputError", "ServerUnreachable", "SourceError",
    "TransportError", "TsfusionError", "WeightOverflow", "WorkerLost", "WorldRefused",
)  # fmt: skip
_HOME = {
    "Blocks": "tsdf.files.voxel_arrays",
    "Client": "client",
    "Config": "core.config",
    "DistanceField": "geometry.map_grids",
    "DistanceSlice": "geometry.map_grids",
    "Intrinsics": "geometry.keyframe",
    "Keyframe": "geometry.keyframe",
    "Layout": "datasets",
    "MapClient": "wire.asking.map_client",
    "Mesh": "geometry.mesh",
    "PointCloud": "geometry.map_answers",
    "Samples": "geometry.map_answers",
    "OccupancySlice": "geometry.map_grids",
    "SliceGrid": "geometry.map_grids",
    "Source": "scanner.sources.source",
    "View": "geometry.map_answers",
    "Volume": "tsdf.volume",
    "VolumeConfig": "core.config",
    "open_dataset": "datasets",
    "open_source": "scanner.sources.source",
    **dict.fromkeys(_ERRORS, "core.errors"),
}
__all__ = ["__version__", *_HOME]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"tsfusion.{_HOME[name]}"), name)
    raise AttributeError(f"module 'tsfusion' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
