# SPDX-License-Identifier: MIT
"""Draw charts as SVG, in the colours and fonts of the page around them."""

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 12.0, 12.0, 40.0  # margins, for the labels
_STEPS = (1.0, 2.0, 5.0, 10.0)
MOST_POINTS = 1500  # of a line


class Axis(NamedTuple):
    """Range and title of a chart's axis."""

    low: float
    high: float
    title: str
    ticks: int = 5


class Chart:
    """A plot with two axes.

    Args:
        label: what the chart shows, for screen readers.
        square: both axes have the same scale; their ranges are widened to fit.
    """

    def __init__(
        self, x: Axis, y: Axis, label: str, *, width: int = 520, height: int = 270, square: bool = False
    ) -> None:
        self._width, self._height, self._label = width, height, label
        self.x, self.y = _widened(x), _widened(y)
        if square:
            inner = (width - _LEFT - _RIGHT, height - _TOP - _BOTTOM)
            scale = max((self.x.high - self.x.low) / inner[0], (self.y.high - self.y.low) / inner[1])
            self.x, self.y = _stretched(self.x, scale * inner[0]), _stretched(self.y, scale * inner[1])
        self._parts: list[str] = []

    def line(self, xs: NDArray[np.float64], ys: NDArray[np.float64], style: str) -> None:
        """Draw a line through (n,) points. NaN interrupts it. Of many points every k-th is drawn."""
        step = max(1, math.ceil(len(xs) / MOST_POINTS))
        pieces: list[str] = []
        pen_up = True
        for x, y in zip(self._px(xs[::step]), self._py(ys[::step]), strict=True):
            if math.isnan(x) or math.isnan(y):
                pen_up = True
                continue
            pieces.append(f"{'M' if pen_up else 'L'}{x:.1f} {y:.1f}")
            pen_up = False
        self._parts.append(f'<path class="line {style}" d="{"".join(pieces)}"/>')

    def bars(
        self,
        edges: NDArray[np.float64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        style: str,
    ) -> None:
        """Draw bars between (n + 1,) `edges` that reach from (n,) `low` to `high`."""
        x, bottom, top = self._px(edges), self._py(low), self._py(high)
        rows = zip(x[:-1], x[1:], bottom, top, strict=True)
        boxes = (f"M{a:.1f} {b:.1f}V{t:.1f}H{z:.1f}V{b:.1f}Z" for a, z, b, t in rows if b - t > 0.05)
        self._parts.append(f'<path class="bar {style}" d="{"".join(boxes)}"/>')

    def points(self, xs: NDArray[np.float64], ys: NDArray[np.float64], style: str, size: float = 2.0) -> None:
        """Draw a dot at each of (n,) points."""
        step = max(1, math.ceil(len(xs) / MOST_POINTS))
        places = zip(self._px(xs[::step]), self._py(ys[::step]), strict=True)
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in places)
        self._parts.append(f'<path class="dots {style}" stroke-width="{2 * size:g}" d="{dots}"/>')

    def level(self, value: float, text: str) -> None:
        """Draw a dashed horizontal line at a value of y, with a text."""
        y = float(self._py(np.array([value]))[0])
        right = self._width - _RIGHT
        self._parts.append(
            f'<path class="rule" d="M{_LEFT} {y:.1f}H{right}"/>'
            f'<text class="rule-text" x="{right - 4}" y="{y - 5:.1f}" text-anchor="end">{escape(text)}</text>'
        )

    def mark(self, value: float, text: str, row: int = 0) -> None:
        """Draw a dashed vertical line at a value of x, with a text in row `row` from the top."""
        x = float(self._px(np.array([value]))[0])
        y = _TOP + 10 + 15 * row
        left = x > 0.7 * self._width
        self._parts.append(
            f'<path class="rule" d="M{x:.1f} {_TOP}V{self._height - _BOTTOM}"/>'
            f'<text class="rule-text" x="{x + (-4 if left else 4):.1f}" y="{y}" '
            f'text-anchor="{"end" if left else "start"}">{escape(text)}</text>'
        )

    def image(self, url: str, x0: float, y0: float, x1: float, y1: float) -> None:
        """Draw a picture between two corners."""
        (left, right), (bottom, top) = self._px(np.array([x0, x1])), self._py(np.array([y0, y1]))
        self._parts.insert(
            0,
            f'<image href="{url}" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
            f'height="{bottom - top:.1f}" preserveAspectRatio="none"/>',
        )

    def svg(self) -> str:
        """Return the chart as an `<svg>` element."""
        return (
            f'<svg viewBox="0 0 {self._width} {self._height}" role="img" aria-label="{escape(self._label)}">'
            f"{self._grid()}{''.join(self._parts)}{self._titles()}</svg>"
        )

    def _px(self, xs: NDArray[np.float64]) -> NDArray[np.float64]:
        share = (np.asarray(xs, np.float64) - self.x.low) / (self.x.high - self.x.low)
        return _LEFT + share * (self._width - _LEFT - _RIGHT)

    def _py(self, ys: NDArray[np.float64]) -> NDArray[np.float64]:
        share = (np.asarray(ys, np.float64) - self.y.low) / (self.y.high - self.y.low)
        return self._height - _BOTTOM - share * (self._height - _TOP - _BOTTOM)

    def _grid(self) -> str:
        bottom, right = self._height - _BOTTOM, self._width - _RIGHT
        parts = []
        for value in ticks(self.y):
            y = float(self._py(np.array([value]))[0])
            parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{right}"/>')
            parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{number(value)}</text>')
        for value in ticks(self.x):
            x = float(self._px(np.array([value]))[0])
            parts.append(f'<path class="grid" d="M{x:.1f} {bottom}v4"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 17}" text-anchor="middle">{number(value)}</text>')
        parts.append(f'<path class="axis" d="M{_LEFT} {bottom}H{right}"/>')
        return "".join(parts)

    def _titles(self) -> str:
        x = (_LEFT + self._width - _RIGHT) / 2
        y = (_TOP + self._height - _BOTTOM) / 2
        return (
            f'<text class="title" x="{x:g}" y="{self._height - 5}" text-anchor="middle">'
            f"{escape(self.x.title)}</text>"
            f'<text class="title" transform="translate(11 {y:g}) rotate(-90)" text-anchor="middle">'
            f"{escape(self.y.title)}</text>"
        )


def ticks(axis: Axis) -> list[float]:
    """Return round values over the range of an axis, for its tick marks."""
    raw = (axis.high - axis.low) / max(axis.ticks, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor for factor in _STEPS if factor * power >= raw * 0.999) * power
    first = math.ceil(axis.low / step - 1e-9)
    return [k * step for k in range(first, math.floor(axis.high / step + 1e-9) + 1)]


def number(value: float) -> str:
    """Return a tick's value in few characters: 0.25, 1 200, 3."""
    text = f"{value:.10g}" if abs(value) < 1e4 else f"{value:,.0f}".replace(",", "\u202f")
    return "0" if text == "-0" else text.replace("-", "\u2212")


def legend(entries: Iterable[tuple[str, str]]) -> str:
    """Return the HTML of a legend of (style, text) pairs."""
    return (
        '<p class="legend">'
        + "".join(f'<span><i class="{style}"></i>{escape(text)}</span>' for style, text in entries)
        + "</p>"
    )


def span(values: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """Return the smallest and the largest finite value, or 0 and 1 if there is none."""
    known = np.concatenate([np.ravel(each) for each in values]) if values else np.zeros(0)
    known = known[np.isfinite(known)]
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def _widened(axis: Axis) -> Axis:
    if axis.high - axis.low > 1e-9 * max(abs(axis.high), abs(axis.low), 1e-9):
        return axis
    margin = 0.5 * max(abs(axis.high), 1.0) if axis.low != 0 else 0.0
    return axis._replace(low=axis.low - margin, high=axis.high + (margin or 1.0))


def _stretched(axis: Axis, length: float) -> Axis:
    middle = (axis.low + axis.high) / 2
    return axis._replace(low=middle - length / 2, high=middle + length / 2)
