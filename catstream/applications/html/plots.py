"""Line plots as SVG elements for HTML pages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Self

import numpy as np

#: Colours of the curves, in order; distinguishable for colour-blind people, on light and on dark background.
COLOURS = ("#f25100", "#2b82d9", "#56bf9c", "#a63700", "#30b2f2", "#3f8c7f", "#1c678c")

#: Dash patterns of the first four curves, of the next four, and of the others.
DASHES = ("none", "7 4", "2 3")

_WIDTH, _HEIGHT = 460, 320
_LEFT, _TOP, _RIGHT, _BOTTOM = 46, 34, 24, 44
_LETTER, _ROW = 6.6, 18  # width of a letter and height of a row of the legend, in pixels


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from 0 to `high`, with a grid line and a text at each of the `ticks`."""

    label: str
    high: float
    ticks: tuple[tuple[float, str], ...]

    @classmethod
    def upto(cls, value: float, label: str = "") -> Self:
        """Return an axis that includes a value, with round ticks.

        >>> [text for _, text in Axis.upto(0.7).ticks]
        ['0', '0.2', '0.4', '0.6', '0.8']
        """
        step = 10 ** math.floor(math.log10(max(value, 1e-9)))
        step *= next(part for part in (0.1, 0.2, 0.5, 1, 2) if value <= 5 * part * step * (1 + 1e-9))
        count = max(1, math.ceil(value / step - 1e-9))
        return cls(label, count * step, tuple((number * step, f"{number * step:g}") for number in range(count + 1)))


#: Axis for values from 0 to 1.
SHARES = Axis("", 1.0, tuple((tenth / 10, f"{tenth / 10:.1f}") for tenth in range(0, 11, 2)))


def plot(title: str, x: Axis, y: Axis, curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> str:
    """Draw a line plot.

    Parameters
    ----------
    title : title above the plot
    x, y : axes; values outside their range are clipped
    curves : label -> x and y values, float64 (k,) both; NaN makes a gap, and a curve may be empty

    Returns
    -------
    an `<svg>` element; axes and text have the text colour of the page
    """
    legend, rows = _legend(list(curves))
    top, tall = _TOP + _ROW * rows, _HEIGHT - _TOP - _BOTTOM
    height, wide, bottom = top + tall + _BOTTOM, _WIDTH - _LEFT - _RIGHT, top + tall

    def across(values: np.ndarray | float) -> np.ndarray:
        return _LEFT + wide * np.clip(values, 0, x.high) / x.high

    def down(values: np.ndarray | float) -> np.ndarray:
        return bottom - tall * np.clip(values, 0, y.high) / y.high

    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(title)}">',
        f'<text x="{_LEFT}" y="20" class="title">{escape(title)}</text>',
        f'<text x="{_LEFT + wide / 2}" y="{height - 8}" text-anchor="middle">{escape(x.label)}</text>',
        f'<text x="{_LEFT + wide}" y="20" text-anchor="end">{escape(y.label)}</text>',
        *legend,
    ]
    for value, text in y.ticks:
        level = f"{down(value):.1f}"
        parts += [
            f'<line x1="{_LEFT}" x2="{_LEFT + wide}" y1="{level}" y2="{level}" class="grid"/>',
            f'<text x="{_LEFT - 6}" y="{down(value) + 4:.1f}" text-anchor="end">{text}</text>',
        ]
    for value, text in x.ticks:
        parts.append(f'<text x="{across(value):.1f}" y="{bottom + 18}" text-anchor="middle">{text}</text>')
    for number, (xs, ys) in enumerate(curves.values()):
        style = f'fill="none" {_stroke(number)} stroke-width="2.2" stroke-linejoin="round"'
        for piece in np.ma.clump_unmasked(np.ma.masked_invalid(ys)) if len(ys) else ():
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across(xs[piece]), down(ys[piece]), strict=True))
            parts.append(f'<polyline points="{points}" {style}/>')
    return "\n".join([*parts, "</svg>"])


def _legend(names: list[str]) -> tuple[list[str], int]:
    """Return the elements of the legend below the title, and its number of rows."""
    parts, x, row = [], float(_LEFT), 0
    for number, name in enumerate(names):
        width = 40 + _LETTER * len(name)
        if x > _LEFT and x + width > _WIDTH:
            x, row = float(_LEFT), row + 1
        y = _TOP + 4 + _ROW * row
        parts += [
            f'<line x1="{x:.0f}" x2="{x + 18:.0f}" y1="{y - 4}" y2="{y - 4}" {_stroke(number)} stroke-width="3"/>',
            f'<text x="{x + 23:.0f}" y="{y}">{escape(name)}</text>',
        ]
        x += width
    return parts, row + 1 if names else 0


def _stroke(number: int) -> str:
    dashes = DASHES[number // 4 % len(DASHES)]
    return f'stroke="{COLOURS[number % len(COLOURS)]}" stroke-dasharray="{dashes}"'
