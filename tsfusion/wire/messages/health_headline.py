# SPDX-License-Identifier: MIT
"""A server's health as one line: is it working, is it keeping up, is anything lost?"""

from tsfusion.core.headline import Headline
from tsfusion.core.readable_numbers import count_of, span
from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth

_RECENT = 10.0  # seconds since the last keyframe in which a server counts as working
_STILL = 5.0  # seconds in which keyframes wait and none is fused, until that is said


def headline(
    health: Health, *, only: str = "", rate: float = 0.0, still: dict[str, float] | None = None
) -> Headline:
    """The state of a server in words.

    Args:
        only: one map and its clients; empty = all.
        rate: keyframes fused a second; 0 = not known.
        still: map → seconds in which keyframes waited there and none was fused, as far as the caller knows.
    """
    maps = {name: one for name, one in health.maps.items() if only in ("", name)}
    clients = [one for one in health.clients if only in ("", one.map)]
    recent = [one.last_keyframe_s for one in maps.values() if one.last_keyframe_s is not None]
    waiting = sum(one.waiting for one in maps.values())
    waiting += sum(one.waiting for one in clients if one.state != "gone")
    doing = "working" if waiting or min(recent, default=_RECENT) < _RECENT else "ready, no input"
    starts = not health.ready and any(one.state == "opening" for one in maps.values())
    return Headline(
        doing="starting" if starts else doing,
        trouble="" if starts and not health.problems else _trouble(health, maps, still or {}),
        waiting=waiting,
        rate=rate,
        lost=sum(map(lost_of_map, maps.values())) + sum(map(lost_of_client, clients)),
    )


def lost_of_map(one: MapHealth) -> int:
    """Keyframes of the journal that are not in the map and will not be."""
    return sum(one.rejected.values()) + one.journal_damaged


def lost_of_client(one: ClientHealth) -> int:
    """Keyframes that the client never sent, or that the server turned away."""
    return one.refused + sum(one.skipped.values())


def _trouble(health: Health, maps: dict[str, MapHealth], still: dict[str, float]) -> str:
    """Reason why a server or a map of it does not work: a few words, as the problems are told at length."""
    longest = max((max(still.get(name, 0.0), one.fusing_s) for name, one in maps.items()), default=0.0)
    if longest >= _STILL:
        return f"nothing fused for {span(longest)}"
    blocked = sum(bool(one.problem) for one in maps.values())
    if blocked and health.ready:
        return (
            "does not work"
            if blocked == len(maps)
            else f"{count_of(blocked, 'map does', 'maps do')} not work"
        )
    return "" if health.ready else "not ready"
