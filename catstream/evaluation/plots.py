"""Line plots as SVG text, to stand inside an HTML page."""

from __future__ import annotations

from html import escape

import numpy as np

__all__ = ["COLOURS", "plot"]

#: Of the curves, in order; distinct for the colour-blind too, on light and on dark.
COLOURS = ("#e8590c", "#1c7ed6", "#2f9e44", "#9c36b5", "#c9a227", "#868e96")

_WIDTH, _HEIGHT = 460, 320
_LEFT, _TOP, _RIGHT, _BOTTOM = 46, 34, 12, 44


def plot(title: str, label: str, places: np.ndarray, curves: dict[str, np.ndarray]) -> str:
    """One plot of shares, 0 to 1, over thresholds.

    Parameters
    ----------
    title : above it
    label : below the thresholds
    places : float64 (k,), the thresholds, rising
    curves : legend -> float64 (k,)

    Returns
    -------
    an `<svg>` element; axes and text take the page's colour
    """
    wide, tall = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    x = _LEFT + wide * places / places[-1]

    def y(share: np.ndarray | float) -> np.ndarray | float:
        return _TOP + tall * (1 - share)

    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">',
        f'<text x="{_LEFT}" y="20" class="title">{escape(title)}</text>',
        f'<text x="{_LEFT + wide / 2}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(label)}</text>',
    ]
    for share in np.linspace(0, 1, 6):
        parts += [
            f'<line x1="{_LEFT}" x2="{_LEFT + wide}" y1="{y(share):.1f}" y2="{y(share):.1f}" class="grid"/>',
            f'<text x="{_LEFT - 6}" y="{y(share) + 4:.1f}" text-anchor="end">{share:.1f}</text>',
        ]
    for share in np.linspace(0, 1, 6):
        place = share * places[-1]
        parts.append(
            f'<text x="{_LEFT + wide * share:.1f}" y="{_TOP + tall + 18}" text-anchor="middle">{place:g}</text>'
        )
    for number, (legend, curve) in enumerate(curves.items()):
        colour = COLOURS[number % len(COLOURS)]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, np.atleast_1d(y(curve)), strict=True))
        # Legends where the curves leave room: low on the left of falling ones, low on the right of rising ones.
        row = _TOP + tall - 12 - 18 * (len(curves) - 1 - number)
        start = _LEFT + 12 if curve[0] > curve[-1] else _LEFT + wide - 170
        parts += [
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2.2" stroke-linejoin="round"/>',
            f'<rect x="{start}" y="{row - 5}" width="16" height="3" fill="{colour}"/>',
            f'<text x="{start + 22}" y="{row}">{escape(legend)}</text>',
        ]
    return "\n".join([*parts, "</svg>"])
