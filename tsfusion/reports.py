# SPDX-License-Identifier: MIT
"""A map's status: what its fuser knows, and what the gateway does."""

import msgspec

from tsfusion import process
from tsfusion.config import ServerConfig
from tsfusion.hosted import HostedMap
from tsfusion.transport import messages, work


def status(
    hosted: HostedMap, fuser: work.FuserStatus, health: messages.Health, server: ServerConfig
) -> messages.Status:
    """The answer to a person who asks how a map is doing."""
    own = health.maps[hosted.name]
    return messages.Status(
        epoch=health.epoch,
        map=hosted.name,
        state=str(hosted.folder),
        fuser="idle" if hosted.drained else "busy",
        uptime_s=health.uptime_s,
        keyframes_durable=own.keyframes_durable,
        keyframes_fused=fuser.keyframes_fused,
        keyframes_rejected=fuser.keyframes_rejected,
        messages_refused=health.refused,
        duplicates=health.duplicates,
        sessions=own.sessions,
        blocks=fuser.blocks,
        voxels=fuser.voxels,
        map_bytes=fuser.map_bytes,
        map_hash=fuser.map_hash,
        color_hash=fuser.color_hash,
        journal_bytes=own.journal_bytes,
        journal_damaged=own.journal_damaged,
        fuser_restarts=own.fuser_restarts,
        peak_rss_bytes={"server": process.peak_rss_bytes(), "fuser": fuser.peak_rss_bytes},
        delay_ms=own.delay_ms,
        delay_bound_ms=own.delay_bound_ms,
        config={"server": msgspec.to_builtins(server), "volume": fuser.config},
        versions=fuser.versions,
    )
