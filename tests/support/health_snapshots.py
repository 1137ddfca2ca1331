# SPDX-License-Identifier: MIT
"""Health snapshots for the tests of what shows them."""

from typing import Any

from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth, Spread

MIB = 1 << 20


def map_health(**fields: Any) -> MapHealth:
    """A map that is well, with 6 keyframes."""
    return MapHealth(**{
        "state": "idle", "problem": "", "keyframes_durable": 6, "keyframes_fused": 5, "waiting": 0,
        "rejected": {"MapFull": 1}, "quarantined": 1, "sessions": 1, "journal_bytes": 3 * MIB,
        "journal_damaged": 0, "fuser_restarts": 0, "blocks": 1234, "map_bytes": 10 * MIB,
        "last_keyframe_s": 2.0, "delay_bound_ms": 0.5,
        "delay_ms": Spread(count=5, mean=21.0, p50=20.0, p95=28.0, p99=30.0, max=61.0), **fields,
    })  # fmt: skip


def client(name: str = "", **fields: Any) -> ClientHealth:
    """A session that sent 6 keyframes."""
    return ClientHealth(**{
        "client": name, "session": "1a2b3c4d", "map": "default", "heard_s": 0.25, "durable": 6, "fused": 6,
        "received_bytes": 3 * MIB, "waiting": 0, "skipped": {}, "held": "", **fields,
    })  # fmt: skip


def health(*clients: ClientHealth, **fields: Any) -> Health:
    """A server that is well, with one map."""
    return Health(**{
        "ready": True, "problems": (), "epoch": "abc", "uptime_s": 3725.0, "rss_bytes": 60 * MIB,
        "refused": {}, "duplicates": 0, "maps": {"default": map_health()}, "clients": clients, **fields,
    })  # fmt: skip
