# SPDX-License-Identifier: MIT
"""A reader of OpenVDB files with one grid of floats, after the library's own, as far as tests need it."""

import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Grid(NamedTuple):
    """A grid: values (8, 8, 8) of each leaf by its block."""

    name: str
    voxel_size: float
    translation: float
    background: float
    leaves: dict[tuple[int, ...], NDArray[np.float32]]


def read(path: Path) -> Grid:
    """Read a file; whatever is not as it must be fails."""
    with path.open("rb") as file:
        magic, version, *_, has_offsets = _numbers(file, "<qIII?")
        assert (magic, version, has_offsets) == (0x56444220, 224, True)
        assert len(file.read(36)) == 36
        _metadata(file)
        assert _numbers(file, "<I") == (1,)
        name, kind, parent = (_text(file) for _ in range(3))
        assert (kind, parent) == ("Tree_float_5_4_3", "")
        begin, values, end = _numbers(file, "<qqq")
        assert file.tell() == begin
        assert _numbers(file, "<I") == (2,)  # active values alone are stored
        assert _metadata(file) == {"class": "unknown", "name": name}
        assert _text(file) == "UniformScaleTranslateMap"
        shift, *scales = np.reshape(_numbers(file, "<18d"), (6, 3))
        size = scales[0][0]
        assert np.allclose(scales, np.array([[size], [size], [1 / size], [1 / size**2], [0.5 / size]]))
        buffers, background = _numbers(file, "<if")
        assert buffers == 1
        leaves = _leaves(file)
        assert file.tell() == values
        found = {}
        for block, mask in leaves:
            assert file.read(65) == mask + b"\0"
            active = np.unpackbits(np.frombuffer(mask, np.uint8), bitorder="little").astype(bool)
            found[block] = np.full(512, background, np.float32)
            found[block][active] = np.frombuffer(file.read(4 * int(active.sum())), "<f4")
            found[block] = found[block].reshape(8, 8, 8)
        assert file.tell() == end
        assert not file.read()
    return Grid(name, size, shift[0], background, found)


def _leaves(file: BinaryIO) -> list[tuple[tuple[int, ...], bytes]]:
    """Blocks and masks of the leaves, in the file's order."""
    tiles, children = _numbers(file, "<II")
    assert tiles == 0
    found = []
    for _ in range(children):
        root = np.array(_numbers(file, "<iii"))
        assert not (root % 4096).any()
        for node in _children(file, 32):
            for leaf in _children(file, 16):
                block = root // 8 + 16 * node + leaf
                found.append((tuple(block.tolist()), file.read(64)))
    return found


def _children(file: BinaryIO, side: int) -> NDArray[np.int64]:
    """Places of a node's children."""
    mask, active = file.read(side**3 // 8), file.read(side**3 // 8)
    assert not any(active)
    assert file.read(1) == b"\0"
    bits = np.unpackbits(np.frombuffer(mask, np.uint8), bitorder="little")
    return np.stack(np.unravel_index(np.flatnonzero(bits), (side,) * 3), axis=1)


def _numbers(file: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _text(file: BinaryIO) -> str:
    return file.read(_numbers(file, "<I")[0]).decode()


def _metadata(file: BinaryIO) -> dict[str, str]:
    found = {}
    for _ in range(_numbers(file, "<I")[0]):
        name, kind, value = (_text(file) for _ in range(3))
        assert kind == "string"
        found[name] = value
    return found
