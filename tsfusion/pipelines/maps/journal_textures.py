# SPDX-License-Identifier: MIT
"""Textures from the images in a journal: at their keyframes' newest poses, without what was forgotten."""

from collections.abc import Collection
from pathlib import Path

from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import TexturedMesh
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.maps import journal_fusion
from tsfusion.tsdf.texture import texturing
from tsfusion.tsdf.texture.texturing import TextureSettings


class JournalImages:
    """The keyframes of a journal as a texture takes them; None where one is of no use."""

    def __init__(self, keyframes: JournaledKeyframes) -> None:
        self._keyframes = keyframes

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, index: int) -> Keyframe | None:
        """Read a keyframe.

        Raises:
            JournalError: when it cannot be read any more.
        """
        try:
            return self._keyframes[index].keyframe
        except (DecodeError, InvalidKeyframe):  # the map could not take it either, and whoever made it told
            return None


def textured(
    mesh: Mesh,
    source: Path,
    voxel_size: float,
    settings: TextureSettings | None = None,
    *,
    until: str | None = None,
    only: Collection[str] = (),
    reading: OnProgress = lambda _done, _all: None,
    watch: texturing.StageProgress = lambda _stage, _done, _all: None,
) -> TexturedMesh:
    """Give the mesh of a map a texture from the images in its journal.

    Args:
        source: what `state_folder.find_journal` takes.
        voxel_size: metres, of the map.
        until, only: the keyframes, as `journal_fusion.choose` has them.

    Raises:
        JournalError: when there is no journal, or it has no keyframes; others as `texturing.textured`.
    """
    keyframes = journal_fusion.choose(source, until=until, only=only, watch=reading)
    if not len(keyframes):
        raise JournalError(f"a texture needs the images in the journal, but {source} has no keyframes")
    return texturing.textured(mesh, JournalImages(keyframes), voxel_size, settings, watch=watch)
