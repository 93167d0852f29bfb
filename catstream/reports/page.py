"""Self-contained HTML pages for any display: tables, pictures, line plots and timelines."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Self

import numpy as np

from catstream.base.files import write_atomically, writing

#: Colours of the curves, in order; distinguishable for colour-blind people, on light and on dark background.
COLOURS = ("#f25100", "#2b82d9", "#56bf9c", "#a63700", "#30b2f2", "#3f8c7f", "#1c678c")

#: Dash patterns of the first four curves, of the next four, and of the others.
DASHES = ("none", "7 4", "2 3")

_WIDTH, _HEIGHT = 460, 320
_LEFT, _TOP, _RIGHT, _BOTTOM = 46, 34, 24, 44
_LETTER, _ROW = 6.6, 18  # width of a letter and height of a row of the legend, in pixels

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1060px; margin: 2.5rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p.about, figcaption { opacity: .75; margin: .2rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .55rem; text-align: right; border-bottom: 1px solid var(--line); }
th.text, td.text { text-align: left; }
tr.mean td { font-weight: 600; } small { opacity: .65; }
.good { color: #2f9e44; } .bad { color: #e03131; font-weight: 600; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(380px, 100%), 1fr)); gap: 1.2rem; }
svg text { font-size: 12px; fill: currentColor; } svg .title { font-size: 14px; font-weight: 600; }
svg .grid { stroke: var(--line); }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(220px, 44%), 1fr)); gap: 1rem .8rem;
  align-items: end; margin-top: 1.6rem; }
.pictures figure { margin: 0; min-width: 0; } .pictures img { display: block; width: 100%; border-radius: 6px; }
.pictures figcaption { font-size: 13px; margin-top: .35rem; line-height: 1.35; font-variant-numeric: tabular-nums; }
.pictures b { display: block; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; font-weight: 600; }
.timeline { margin: .2rem 0 .9rem; }
.lane { position: relative; height: 12px; margin: 3px 0; border-radius: 3px; overflow: hidden;
  background: var(--soft); }
.lane i { position: absolute; top: 0; bottom: 0; min-width: 3px; border-radius: 2px; background: var(--colour); }
.ends { display: flex; justify-content: space-between; line-height: 1.2; }
.legend span { margin-right: 1.2rem; white-space: nowrap; }
.legend span::before { content: ""; display: inline-block; width: .8em; height: .8em; margin-right: .4em;
  border-radius: 2px; background: var(--colour); }
.file { margin: 0; overflow-wrap: anywhere; }
pre { background: var(--soft); padding: .8rem; border-radius: 6px; overflow-x: auto; }
"""


def table(heads: Iterable[str], rows: Iterable[Iterable[object]], *, texts: int = 1, means: int = 0) -> str:
    """Return a table of HTML cells. The first `texts` columns are left-aligned, the last `means` rows are bold."""

    def line(kind: str, cells: Iterable[object]) -> str:
        return "".join(
            f'<{kind} class="text">{cell}</{kind}>' if number < texts else f"<{kind}>{cell}</{kind}>"
            for number, cell in enumerate(cells)
        )

    lines = [line("td", row) for row in rows]
    marked = [f"<tr>{row}</tr>" for row in lines[: len(lines) - means]]
    marked += [f'<tr class="mean">{row}</tr>' for row in lines[len(lines) - means :]]
    return "\n".join(
        ['<div class="wide"><table>', f"<tr>{line('th', map(escape, heads))}</tr>", *marked, "</table></div>"]
    )


def figure(jpeg: bytes, title: str, caption: str, tooltip: str) -> str:
    """A picture with a title and a caption below it; the tooltip is shown if the pointer is over the title."""
    title, caption, tooltip = escape(title), escape(caption), escape(tooltip)
    shown = f'<img src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode("ascii")}" alt="{title}">'
    return f'<figure>{shown}<figcaption><b title="{tooltip}">{title}</b>{caption}</figcaption></figure>'


def write_page(path: Path, title: str, body: Iterable[str]) -> Path:
    """Write a page with the non-empty parts of `body`, atomically."""
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>catstream: {escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n<body>\n'
        + "\n".join(part for part in body if part)
        + "\n</body></html>\n"
    )
    with writing(path):
        write_atomically(path, page.encode(errors="surrogateescape"))
    return path


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
    """Draw a line plot, and return the `<svg>` element.

    x, y : axes; values outside their range are clipped
    curves : label -> x and y values, float64 (k,) both; NaN makes a gap, and a curve may be empty
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


@dataclass(frozen=True, slots=True)
class Bar:
    """A span of seconds in a lane; the text is shown if the pointer is over it, the strength is the opacity, 0 to 1."""

    begin: float
    end: float
    text: str
    strength: float = 1.0


def timeline(seconds: float, lanes: Mapping[str, Iterable[Bar]], colours: Mapping[str, str]) -> str:
    """Draw a timeline from 0 to `seconds`, with a lane of bars for each name, from the top."""
    seconds = max(seconds, 1e-3)
    drawn = []
    for name, bars in lanes.items():
        spans = "".join(
            f'<i title="{escape(bar.text)}" style="left:{100 * bar.begin / seconds:.2f}%;'
            f'width:{100 * (bar.end - bar.begin) / seconds:.2f}%;opacity:{bar.strength:.2f}"></i>'
            for bar in bars
        )
        drawn.append(f'<div class="lane" style="--colour:{colours[name]}" title="{escape(name)}">{spans}</div>')
    ends = f"<small>0:00</small><small>{clock(seconds)}</small>"
    return f'<div class="timeline">{"".join(drawn)}<div class="ends">{ends}</div></div>'


def legend(colours: Mapping[str, str]) -> str:
    """The names of the lanes in their colours."""
    names = "".join(f'<span style="--colour:{colour}">{escape(name)}</span>' for name, colour in colours.items())
    return f'<p class="legend">{names}</p>'


def clock(seconds: float) -> str:
    """Format a time.

    >>> clock(75.25), clock(3675)
    ('1:15.2', '1:01:15.0')
    """
    minutes, rest = divmod(round(seconds * 10), 600)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest / 10:04.1f}" if hours else f"{minutes}:{rest / 10:04.1f}"
