# SPDX-License-Identifier: MIT
"""Colour a tile's vertices: as seen, or by height, direction, weight, scanner, age or a measure; choose
colours for numbers and names, also for colour-blind people."""

import colorsys
import html
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.map.map_tiles import GREY, CellKey, MapTiles, Tile
from tsfusion.viewer.map.vertex_values import Function, VertexValues

PICTURE, HEIGHT, NORMAL, WEIGHT, CLIENT, AGE = "Picture", "Height", "Normal", "Weight", "Scanner", "Age"
_UNKNOWN = (125, 125, 125)
_FEW = 64  # values of each tile used to find the scale's ends
_UNIT = re.compile(r"(.*) \[(.+)\]")  # a measure's name with its unit
_LIGHT = 0.45  # loss of brightness of a surface that faces away from the light
_STOPS = 9  # colours in a legend's bar
# Okabe and Ito's, without black: RGB
_PALETTE = (0x0072B2, 0xE69F00, 0x009E73, 0xCC79A7, 0x56B4E9, 0xD55E00, 0xF0E442)
_GOLDEN = 0.618034  # of a turn of hue between further colours
_STEPS = (1, 2, 3, 4, 5, 8, 10)


@dataclass(frozen=True)
class Scale:
    """Range of a colour scale: the values of its first and its last colour."""

    low: float
    high: float

    def colors(self, values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
        """Return (n, 3) RGB of (n,) values; grey for NaN."""
        share = np.nan_to_num((values - self.low) / (self.high - self.low))
        colors: NDArray[np.uint8] = color_ramp()[np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)]
        colors[np.isnan(values)] = _UNKNOWN
        return colors


class VertexColors:
    """Chosen way to colour tiles: as seen, by height, direction, weight, scanner, age, or a measure.

    Args:
        tiles: tiles to colour.
        weights: function for the map's weights at points.
        measures: more quantities by name; the name may end with a unit in brackets: `error [m]`.
    """

    def __init__(self, tiles: MapTiles, weights: Function, measures: Mapping[str, Function]) -> None:
        self._tiles = tiles
        self.values = VertexValues({WEIGHT: weights, **measures})
        self.names = [PICTURE, HEIGHT, NORMAL, WEIGHT, CLIENT, AGE, *measures]
        self.mode = PICTURE
        self.scale: Scale | None = None
        self.up = np.array((0.0, 0.0, 1.0))
        self._of_client: Callable[[bytes], str] = lambda session: session.hex()[:8]

    def choose(self, mode: str) -> None:
        self.mode, self.scale = mode, None
        self.values.choose(mode)

    def name_clients(self, name: Callable[[bytes], str]) -> None:
        """Set the function that gives sessions their names."""
        self._of_client = name

    @property
    def is_asked_for(self) -> bool:
        """True if values to colour by come from a function on another thread, later than triangles."""
        return self.mode in self.values.names

    def colors(self, key: CellKey, tile: Tile) -> NDArray[np.uint8]:
        """Return (n, 3) sRGB colours of a tile's vertices."""
        mesh = tile.mesh
        assert mesh.colors is not None
        if self.mode == PICTURE:
            return mesh.colors if self._tiles.has_colors else self._shaded(mesh.colors, mesh.normals)
        if self.mode == NORMAL:
            facing: NDArray[np.uint8] = np.rint(127.5 * (mesh.normals + 1)).astype(np.uint8)
            return facing
        if self.mode == CLIENT:
            palette = np.array([*map(item_color, range(len(self._tiles.clients))), _UNKNOWN], np.uint8)
            return self._shaded(palette[tile.client[tile.cell_of_vertex]], mesh.normals)
        values = self._values(key, tile)
        if values is None or self.scale is None:
            return self._shaded(np.full(mesh.vertices.shape, GREY, np.uint8), mesh.normals)
        return self._shaded(self.scale.colors(values), mesh.normals)

    def fit_scale(self) -> bool:
        """Fit the colour scale to the present values; return True if it changed, and with it all colours."""
        before = self.scale
        if self.mode in {HEIGHT, AGE} or self.is_asked_for:
            self.scale = self._fitted()
        return self.scale != before

    def legend(self) -> str:
        if self.mode == CLIENT:
            names = [html.escape(self._of_client(session)) for session in self._tiles.clients]
            return " ".join(_swatch(item_color(i)) + name for i, name in enumerate(names)) or "not known"
        if self.mode == NORMAL:
            return "red, green, blue: facing +x, +y, +z of the map"
        if self.is_asked_for and self.scale is None:
            return "not known now" if self.values.is_unknown else "being asked for …"
        if self.scale is None:
            return ""
        name, unit = self._unit()
        return _bar(f"{html.escape(name)}", self.scale, html.escape(unit))

    def _unit(self) -> tuple[str, str]:
        known = {HEIGHT: ("height", "m"), WEIGHT: ("weight: samples", ""), AGE: ("last change, after", "s")}
        if self.mode in known:
            return known[self.mode]
        found = _UNIT.fullmatch(self.mode)
        return (found[1], found[2]) if found else (self.mode, "")

    def _values(self, key: CellKey, tile: Tile) -> NDArray[np.floating[Any]] | None:
        if self.mode == HEIGHT:
            return tile.mesh.vertices @ self.up.astype(np.float32)
        if self.mode == AGE:
            return tile.changed_s[tile.cell_of_vertex]
        return self.values.of(key, tile)

    def _fitted(self) -> Scale | None:
        if self.mode == HEIGHT:
            up = self.up.astype(np.float32)
            parts = [_few(tile.mesh.vertices) @ up for tile in list(self._tiles.tiles.values())]
        elif self.mode == AGE:
            parts = [tile.changed_s[_few(tile.cell)] for tile in list(self._tiles.tiles.values())]
        else:
            parts = [_few(values) for values in self.values.known()]
        found = np.concatenate(parts) if parts else np.zeros(0)
        found = found[np.isfinite(found)]
        if not len(found):
            return None
        low, high = (float(end) for end in np.percentile(found, (1, 99)))
        if self.mode in {HEIGHT, AGE}:
            grain = rounded_up(max(high - low, 0.1)) / 10
            first = math.floor(low / grain)
            return Scale(grain * first, grain * max(math.ceil(high / grain), first + 1))
        return Scale(-rounded_up(-low) if low < 0 else 0.0, rounded_up(high))

    def _shaded(self, colors: NDArray[np.uint8], normals: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the colours lit from above and one side, so that shape is visible without a photo."""
        side = np.roll(self.up, 1)
        light = self.up + 0.6 * (side - (side @ self.up) * self.up)
        light /= np.linalg.norm(light)
        facing = 0.5 + 0.5 * (normals @ light.astype(np.float32))
        found: NDArray[np.uint8] = np.rint(colors * (1 - _LIGHT + _LIGHT * facing[:, None])).astype(np.uint8)
        return found


def _few(values: NDArray[Any]) -> NDArray[Any]:
    return values[:: max(len(values) // _FEW, 1)]


def _swatch(rgb: tuple[int, int, int]) -> str:
    style = f"display:inline-block;width:.8em;height:.8em;border-radius:2px;background:{hex_color(rgb)}"
    return f'<span style="{style}"></span>&nbsp;'


def _bar(name: str, scale: Scale, unit: str) -> str:
    stops = color_ramp()[np.linspace(0, 255, _STOPS).astype(int)].tolist()
    colors = [hex_color(tuple(color)) for color in stops]
    unit = f"&nbsp;{unit}" if unit else ""
    numbers = [f"{number:.4g}" for number in (scale.low, (scale.low + scale.high) / 2, scale.high)]
    numbers[2] += unit
    bar = f"height:.8em;border-radius:3px;background:linear-gradient(90deg,{','.join(colors)})"
    row = "display:flex;justify-content:space-between"
    return (
        f'<div>{name}</div><div style="{bar}"></div>'
        f'<div style="{row}"><span>{"</span><span>".join(numbers)}</span></div>'
    )


@cache
def color_ramp() -> NDArray[np.uint8]:
    """Return (256, 3) uint8 RGB of the colour map viridis: dark is low, bright is high."""
    import cv2

    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(bgr.reshape(-1, 3)[:, ::-1])


def item_color(index: int) -> tuple[int, int, int]:
    """Return the RGB colour of list item number `index`, such as a scanner's."""
    if index < len(_PALETTE):
        packed = _PALETTE[index]
        return packed >> 16, packed >> 8 & 255, packed & 255
    red, green, blue = colorsys.hsv_to_rgb(index * _GOLDEN % 1, 0.65, 0.9)
    return round(255 * red), round(255 * green), round(255 * blue)


def hex_color(rgb: tuple[int, int, int]) -> str:
    """Return a colour as #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def rounded_up(most: float) -> float:
    """Return the next number that is 1, 2, 3, 4, 5 or 8 times a power of ten, at least 0.001."""
    most = max(most, 1e-3)
    power = 10.0 ** math.floor(math.log10(most))
    return next(step for step in _STEPS if step * power >= most) * power
