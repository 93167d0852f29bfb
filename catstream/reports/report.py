"""Reports: self-contained HTML pages for any display, made from the templates in `templates/`."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import cycle
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from catstream.base.arrays import Float64
from catstream.base.files import write_atomically, writing

#: Colours of the curves, in order; distinguishable for colour-blind people, on light and on dark background.
COLOURS = ("#f25100", "#2b82d9", "#56bf9c", "#a63700", "#30b2f2", "#3f8c7f", "#1c678c")


def write_page(path: Path, template: str, **values: object) -> Path:
    """Write the page of a template atomically; all values are escaped."""
    page = _environment().get_template(template).render(values)
    with writing(path):
        write_atomically(path, page.encode(errors="surrogateescape"))  # the name of a file need not be UTF-8
    return path


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("catstream.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["clock"] = clock
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return environment


@dataclass(frozen=True, slots=True)
class Plot:
    """A line plot of shares from 0 to 1 over thresholds from 0 to `high`.

    label    of the thresholds
    curves   the points of the polyline of each curve, by its name
    colours  of the curves, by their order: it is that of the trackers in all plots of a report
    """

    title: str
    label: str
    high: float
    curves: dict[str, str]
    colours: dict[str, str]

    @classmethod
    def of(cls, title: str, label: str, thresholds: np.ndarray, shares: Mapping[str, Float64]) -> Plot:
        """Plot shares, float64 (k,), over thresholds (k,), by the names of the curves."""
        high = float(thresholds[-1])
        xs = 46 + 390 * thresholds / high
        curves = {name: " ".join(map("{:.1f},{:.1f}".format, xs, 276 - 240 * ys)) for name, ys in shares.items()}
        return cls(title, label, high, curves, dict(zip(curves, cycle(COLOURS), strict=False)))


def clock(seconds: float) -> str:
    """Format a time.

    >>> clock(75.25), clock(3675)
    ('1:15.2', '1:01:15.0')
    """
    minutes, rest = divmod(round(seconds * 10), 600)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest / 10:04.1f}" if hours else f"{minutes}:{rest / 10:04.1f}"
