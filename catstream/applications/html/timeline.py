"""Timelines as HTML elements: bars of time in lanes, which keep their text size on a narrow display."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape


@dataclass(frozen=True, slots=True)
class Bar:
    """A span of time in a lane.

    begin, end  in seconds
    text        shown if the pointer is over it
    strength    opacity, from 0 to 1
    """

    begin: float
    end: float
    text: str
    strength: float = 1.0


def timeline(seconds: float, lanes: Mapping[str, Iterable[Bar]], colours: Mapping[str, str]) -> str:
    """Draw a timeline from 0 to `seconds`, with a lane of bars for each name.

    Parameters
    ----------
    lanes : name -> bars, from the top
    colours : name -> colour of its bars
    """
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
