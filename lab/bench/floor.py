# SPDX-License-Identifier: MIT
"""The least time that a keyframe's memory traffic takes, from bandwidth measured in the same run."""

import time
from typing import Any

import numpy as np

from tsfusion.kernels.base.voxel_traversal import COUNT, RAY_FIELDS

LINE = 64  # bytes that move together


def bandwidth() -> float:
    """Bytes a CPU second that one core reads and writes, copying arrays larger than any cache."""
    source = np.ones(8 << 20)
    target = np.empty_like(source)
    best = 0.0
    for _ in range(5):
        started = time.process_time()
        np.copyto(target, source)
        best = max(best, 2 * source.nbytes / (time.process_time() - started))
    return best


def traffic(volume: Any, keyframe: Any) -> dict[str, int]:
    """Bytes that fusing one more keyframe has to move, by stage: what it reads, and what it writes twice."""
    measured = keyframe.measurement.nbytes
    if volume.config.color and keyframe.color is not None:
        measured += keyframe.color.nbytes
    store = volume._store
    volume.integrate(keyframe)  # so that every block is there
    before = {name: layer[: store.count].copy() for name, layer in store.layers().items()}
    volume.integrate(keyframe)
    lines = 0
    for name, layer in store.layers().items():
        values = LINE // layer.itemsize
        changed = layer[: store.count] != before[name]
        lines += int(changed.reshape(-1, values).any(axis=1).sum())
    volume.retract(keyframe)
    volume.retract(keyframe)
    rays = int(volume._ray_buffers.strips[:, COUNT].sum()) * RAY_FIELDS * 4
    return {"rays": measured + 2 * rays, "integrate": rays + 2 * LINE * lines}


def floor(volume: Any, keyframe: Any, stages_cpu_ms: dict[str, float]) -> dict[str, Any]:
    """Milliseconds of memory traffic a stage, and how many times that the stage takes."""
    speed = bandwidth()
    floors = {stage: size / speed * 1e3 for stage, size in traffic(volume, keyframe).items()}
    return {
        "bandwidth_GB_s": round(speed / 1e9, 2),
        "floor_cpu_ms": {stage: round(ms, 3) for stage, ms in floors.items()},
        "times_floor": {
            stage: round(stages_cpu_ms[stage] / ms, 1)
            for stage, ms in floors.items()
            if stage in stages_cpu_ms
        },
    }
