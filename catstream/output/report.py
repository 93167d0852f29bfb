"""Reports: self-contained HTML pages, rendered from the templates in `templates/`."""

from __future__ import annotations

import base64
import math
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from catstream.base.files import write_atomically, writing

#: Colours of the curves, in order; distinguishable for colour-blind people, on light and on dark background.
COLOURS = ("#f25100", "#2b82d9", "#56bf9c", "#a63700", "#30b2f2", "#3f8c7f", "#1c678c")


def write_page(path: Path, template: str, **values: object) -> Path:
    """Render a template to a page, atomically; all values are escaped."""
    page = _environment().get_template(template).render(values)
    with writing(path):
        write_atomically(path, page.encode(errors="surrogateescape"))  # a file name need not be UTF-8
    return path


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("catstream.output"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["clock"] = clock
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode("ascii")
    return environment


def round_up(value: float) -> float:
    """Round up to a limit for an axis.

    >>> round_up(3.1), round_up(731.0)
    (3.5, 750.0)
    """
    step = 10.0 ** math.floor(math.log10(value)) / 2
    return step * math.ceil(value / step)


def clock(seconds: float) -> str:
    """Format a time.

    >>> clock(75.25), clock(3675)
    ('1:15.2', '1:01:15.0')
    """
    minutes, rest = divmod(round(seconds * 10), 600)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest / 10:04.1f}" if hours else f"{minutes}:{rest / 10:04.1f}"
