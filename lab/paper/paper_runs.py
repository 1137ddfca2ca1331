# SPDX-License-Identifier: MIT
"""Runs of the paper's experiments: which there are, under which limits, and what each is called."""

from collections.abc import Sequence
from typing import Any, Literal

import msgspec
from msgspec import Struct

from lab.paper.paper_worlds import PaperWorld
from tsfusion.core.config import VolumeConfig, make_settings

Mode = Literal[
    "traditional-unbounded",
    "traditional-bounded",
    "one-machine",
    "decentralised",
    "slow-server",
    "slow-link",
    "loops",
    "two-robots",
    "killed-server",
    "lost-packets",
]
MODES: dict[str, str] = {
    "traditional-unbounded": "localisation and fusion in one process, unbounded queue",
    "traditional-bounded": "the same process, but the newest keyframe replaces the one that waits",
    "one-machine": "scanner and server as two processes, on the machine of the modes before",
    "decentralised": "scanner and server",
    "slow-server": "scanner and a server that gets a share of its time only",
    "slow-link": "scanner and server, a slow and distant link between them",
    "loops": "decentralised, and closed loops correct the map",
    "two-robots": "two robots send half of the keyframes each, at the same time",
    "killed-server": "the server is killed in the middle and started again",
    "lost-packets": "one packet in ten is lost",
}
LIVE: tuple[Mode, ...] = tuple(MODES)[:7]  # type: ignore[assignment]
AGAIN: tuple[Mode, ...] = tuple(MODES)[7:]  # type: ignore[assignment] # the keyframes of a live run, sent again
MapName = Literal["off", "regularised"]
ON_ONE_MACHINE: tuple[Mode, ...] = LIVE[:3]
MAPS: dict[str, dict[str, Any]] = {
    "off": {"regularizer": "off", "surface": "raw"},
    "regularised": {"regularizer": "ray", "surface": "field"},
}


class Machine(Struct, frozen=True, kw_only=True):
    """Limits of the processes of one machine. Those of a small machine are simulated on this one.

    Attributes:
        cores: that its processes may use; None = all.
        share: of the time that it may run; 1 = all.
        memory_bytes: resident memory at which its process is killed, as a system without more would; None =
            the real machine's.
    """

    name: str = "whole"
    cores: int | None = None
    share: float = 1.0
    memory_bytes: int | None = None

    @property
    def described(self) -> str:
        """The limits, in words."""
        if self == Machine():
            return "all of this machine"
        parts = [] if self.cores is None else [f"{self.cores} core{'s' * (self.cores > 1)}"]
        parts += [f"{100 * self.share:.0f} % of its time"] * (self.share < 1)
        if self.memory_bytes is not None:
            parts.append(f"{self.memory_bytes / 2**20:.0f} MiB")
        return f"simulated small machine: {', '.join(parts)}"


class Limits(Struct, frozen=True, kw_only=True):
    """All that is made small or slow on purpose.

    Attributes:
        pace: the recording plays so many times slower than it was taken; 1 = in real time.
    """

    robot: Machine = Machine(name="robot", cores=1, memory_bytes=3 << 29)
    server_share: float = 0.35
    link_bytes_per_second: int = 2_500_000
    link_delay_s: float = 0.005  # each way
    lost_share: float = 0.1  # of the packets
    drain_s: float = 30.0  # after the last frame, for what waits
    pace: float = 1.0


class Run(Struct, frozen=True, kw_only=True):
    """One mode on one world, with one map, once."""

    world: PaperWorld
    mode: Mode
    map: MapName
    machine: Machine  # of the process that localises
    number: int = 1

    @property
    def name(self) -> str:
        machine = "" if self.machine.name == "whole" else f"-{self.machine.name}"
        return f"{self.world.name}-{self.mode}-{self.map}{machine}-{self.number}"

    @property
    def volume(self) -> VolumeConfig:
        """Settings of its map; the color of a grey street tells nothing, and is fused all the same."""
        settings = {"voxel_size": self.world.voxel_size, "sensor": self.world.sensor, **MAPS[self.map]}
        return make_settings(VolumeConfig, settings)

    @property
    def seconds(self) -> float:
        """About how long it takes: the recording, and the start of what runs."""
        frames = self.world.limit or {"kitti06": 1101, "kitti07": 1101}.get(self.world.name, 250)
        return 15.0 if self.mode in AGAIN else 0.1 * frames + 12.0


def plan(
    worlds: list[PaperWorld], limits: Limits, *, quick: bool, runs: int = 1, only: Sequence[str] = ()
) -> list[Run]:
    """All runs, in the order in which they are made: those sent again after those whose keyframes they send.

    Args:
        quick: the regularised map only, and no second machine.
        runs: of each mode; with one, the plain map is made in the first world alone.
        only: those whose name holds one of these words, and those that they need; empty = all.
    """
    found: list[Run] = []
    for number in range(1, runs + 1):
        for world in worlds:
            main = world is worlds[0]
            # the plain map of another world tells about its delivery and its poses what the main one's does
            only_regularised = quick or (runs == 1 and not main)
            found += _of_world(world, limits, number, quick=quick, main=main, plain=not only_regularised)
    chosen = [run for run in found if not only or any(word in run.name for word in only)]
    names = {run.name for run in chosen} | {source_of(run).name for run in chosen if run.mode in AGAIN}
    return [run for run in found if run.name in names]


def source_of(run: Run) -> Run:
    """The live run whose keyframes a run sends again."""
    return msgspec.structs.replace(run, mode="decentralised")


def _of_world(
    world: PaperWorld, limits: Limits, number: int, *, quick: bool, main: bool, plain: bool
) -> list[Run]:
    whole, found = Machine(), []
    maps: tuple[MapName, ...] = ("off", "regularised") if plain else ("regularised",)
    for each in maps:
        for mode in LIVE[:6] if main else LIVE[:4]:
            if (mode, each) != ("one-machine", "off"):  # the second control, once
                machine = limits.robot if mode in ON_ONE_MACHINE else whole
                found.append(Run(world=world, mode=mode, map=each, machine=machine, number=number))
    if not quick:  # the control: as much machine for the traditional modes as for the decentralised one
        found += [
            Run(world=world, mode=mode, map="regularised", machine=whole, number=number)
            for mode in LIVE[:2]
            if main
        ]
    if number == 1 and main:
        modes = (*(("loops",) if world.loops else ()), *AGAIN)
        found += [Run(world=world, mode=mode, map="regularised", machine=whole) for mode in modes]
    elif number == 1 and world.loops:
        found.append(Run(world=world, mode="loops", map="regularised", machine=whole))
    return found
