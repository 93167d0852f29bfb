"""Plots of the documentation as SVG, in the style of the reports; readable on light and on dark background."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from catstream.output.report import COLOURS

Points = Sequence[tuple[float, float]]

_STYLE = """<style>text{font:13px system-ui,sans-serif;fill:#333}.title{font-weight:600;font-size:15px}
.grid{stroke:#8884}@media(prefers-color-scheme:dark){text{fill:#ddd}}</style>"""
_LEFT, _TOP, _WIDTH, _HEIGHT = 70, 74, 660, 300  # the place of the curves, pixels


def lines(
    title: str,
    x: tuple[str, Sequence[float]],
    y: tuple[str, Sequence[float]],
    curves: Mapping[str, Points],
) -> str:
    """Plot curves by their names. The legend is above them.

    x, y : label of each axis with its unit, and its ticks, from one end to the other
    """
    parts = [_text(_LEFT, 22, title, "start", "title"), _text(_LEFT + _WIDTH / 2, _TOP + _HEIGHT + 44, x[0])]
    parts.append(_text(_LEFT, 66, y[0], "start"))
    for tick in x[1]:
        parts.append(_text(_LEFT + _at(tick, x[1], _WIDTH), _TOP + _HEIGHT + 22, f"{tick:,}"))
    for tick in y[1]:
        height = _TOP + _HEIGHT - _at(tick, y[1], _HEIGHT)
        parts += [_grid(_LEFT, height, _LEFT + _WIDTH), _text(_LEFT - 8, height + 4, f"{tick:,g}", "end")]
    for colour, (_, points) in zip(COLOURS, curves.items(), strict=False):
        drawn = ((_LEFT + _at(a, x[1], _WIDTH), _TOP + _HEIGHT - _at(b, y[1], _HEIGHT)) for a, b in points)
        polyline = " ".join(f"{a:.1f},{b:.1f}" for a, b in drawn)
        parts.append(f'<polyline points="{polyline}" fill="none" stroke="{colour}" stroke-width="2.2"/>')
    return _svg([*parts, *_legend(list(curves))], title, _TOP + _HEIGHT + 56)


def dots(title: str, label: str, rows: Mapping[str, Sequence[float]], names: Sequence[str]) -> str:
    """Plot numbers from 0 to 1: a line for each row, and a dot in it for each of the names."""
    left, step = 180, 19
    bottom, width = 60 + step * len(rows), 760 - 180 - 30
    parts = [_text(left, 22, title, "start", "title")]
    for tick in range(6):
        place = left + width * tick / 5
        parts.append(f'<line x1="{place}" x2="{place}" y1="58" y2="{bottom}" class="grid"/>')
        parts.append(_text(place, bottom + 18, f"{tick / 5:.1f}"))
    parts.append(_text(left + width / 2, bottom + 38, label))
    for number, (row, values) in enumerate(rows.items()):
        y = 70 + step * number
        parts.append(_text(left - 10, y + 4, row, "end"))
        low, high = (left + width * end for end in (min(values), max(values)))
        parts.append(_grid(low, y, high))
        for colour, value in reversed(list(zip(COLOURS, values, strict=False))):  # the first lies on top
            parts.append(f'<circle cx="{left + width * value:.1f}" cy="{y}" r="4.5" fill="{colour}"/>')
    return _svg([*parts, *_legend(names, left)], title, bottom + 50)


def _legend(names: Sequence[str], x: float = _LEFT) -> list[str]:
    parts = []
    for colour, name in zip(COLOURS, names, strict=False):
        parts += [f'<rect x="{x}" y="34" width="11" height="11" rx="2" fill="{colour}"/>']
        parts.append(_text(x + 17, 44, name, "start"))
        x += 44 + 7 * len(name)
    return parts


def _at(value: float, ticks: Sequence[float], length: float) -> float:
    """Return the distance of a value from the first tick, of an axis up to the last one."""
    return length * (value - ticks[0]) / (ticks[-1] - ticks[0])


def _text(x: float, y: float, text: str, anchor: str = "middle", name: str = "") -> str:
    extra = f' class="{name}"' if name else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{extra}>{escape(text)}</text>'


def _grid(left: float, y: float, right: float) -> str:
    return f'<line x1="{left:.1f}" x2="{right:.1f}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>'


def _svg(parts: Sequence[str], title: str, height: float) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 760 {height:g}" role="img">'
    return "\n".join([head, f"<title>{escape(title)}</title>", _STYLE, *parts, "</svg>"]) + "\n"
