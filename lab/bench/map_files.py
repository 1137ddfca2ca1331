#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""How fast a large map is saved and loaded, and how large its file is: one JSON line a direction.

    python lab/bench/map_files.py                        # 200 000 blocks, 2 GB of voxels
    python lab/bench/map_files.py --blocks 20000 --source synthetic:room

A recording is fused, and copies of its map are put side by side until there are so many blocks. Rates are
bytes of voxels a second of wall clock, and of CPU. `taskset -c 0` before it gives the figure of one core.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tsfusion import Volume, open_dataset
from tsfusion.core import process
from tsfusion.tsdf.files.checkpoint import CUBE
from tsfusion.tsdf.store.block_store import pack_keys, unpack_keys

Seconds = dict[str, float]  # of wall clock and of CPU


def large_map(options: argparse.Namespace) -> Volume:
    """Copies of a recording's map, side by side along x."""
    small = Volume(options.voxel_size, regularizer=options.regularizer, threads=len(os.sched_getaffinity(0)))
    dataset = open_dataset(options.source)
    for index in np.linspace(0, len(dataset) - 1, min(options.frames, len(dataset)), dtype=int):
        small.integrate(dataset[int(index)])
    volume = Volume(small.config)
    volume.keyframes = small.keyframes
    used = small._store.used()
    places = unpack_keys(small._store.keys[used])
    step = np.array([int(np.ptp(places[:, 0])) + 2, 0, 0])
    copy = 0
    while volume._store.count < options.blocks:
        count = min(len(used), options.blocks - volume._store.count)
        first = volume._store.count
        volume._store.insert(pack_keys(places[:count] + copy * step))
        for name, layer in volume._store.layers().items():
            layer[first : first + count] = small._store.layers()[name][used[:count]]
        copy += 1
    volume._store.measure_bounds()
    return volume


def timed(call: Callable[[], Any]) -> tuple[Any, Seconds]:
    """The result of a call, with seconds of wall clock and of CPU."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    return result, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def measured(volume: Volume, folder: Path | None) -> tuple[dict[str, float], Seconds, Seconds]:
    """Sizes, and the time of a save and of a load."""
    blocks, map_hash = volume.stats().blocks, volume.map_hash()
    nbytes = blocks * CUBE * sum(layer.itemsize for layer in volume._store.layers().values())
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        path = Path(scratch) / "map.tsf"
        _, saved = timed(partial(volume.save, path))
        size = path.stat().st_size
        loaded, read = timed(partial(Volume.load, path))
    if loaded.map_hash() != map_hash:
        raise SystemExit("the map came back as another")
    cores = len(os.sched_getaffinity(0))
    about = {"blocks": blocks, "voxel_mb": nbytes / 1e6, "file_of_raw": size / nbytes, "cores": cores}
    return about, saved, read


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--source", default="synthetic:room", help="a recording")
    parser.add_argument("--frames", type=int, default=40, help="keyframes of it, evenly")
    parser.add_argument("--voxel-size", type=float, default=0.01, help="metres")
    parser.add_argument("--blocks", type=int, default=200_000)
    parser.add_argument("--regularizer", default="off", help="off, paper or ray: with smoothed values")
    parser.add_argument("--folder", type=Path, help="where the file is written; default: a temporary folder")
    options = parser.parse_args()
    volume = large_map(options)
    about, saved, read = measured(volume, options.folder)
    for verb, took in (("save", saved), ("load", read)):
        rates = {f"mb_per_{name}": about["voxel_mb"] / seconds for name, seconds in took.items()}
        row: dict[str, float] = {**about, **took, **rates, "peak_rss_mb": process.peak_rss_bytes() / 1e6}
        print(json.dumps({"verb": verb, **{key: round(value, 3) for key, value in row.items()}}))


if __name__ == "__main__":
    main()
