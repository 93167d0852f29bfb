"""Writes self-contained HTML pages for light and dark, wide and narrow displays."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from pathlib import Path

from catstream.messages.storage import write_atomically, writing

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
.strip { display: flex; gap: .5rem; overflow-x: auto; padding-bottom: .4rem; }
.strip figure { margin: 0; } .strip img { display: block; border-radius: 4px; }
.strip figcaption { font-size: 12px; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(220px, 44%), 1fr)); gap: 1rem .8rem;
  align-items: end; margin-top: 1.6rem; }
.pictures figure { margin: 0; min-width: 0; } .pictures img { display: block; width: 100%; border-radius: 6px; }
.pictures figcaption { font-size: 13px; margin-top: .35rem; line-height: 1.35; font-variant-numeric: tabular-nums; }
.pictures b { display: block; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; font-weight: 600; }
.missing { display: grid; place-items: center; aspect-ratio: 4 / 3; border-radius: 6px; background: var(--soft); }
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


def figure(jpeg: bytes | None, title: str, caption: str = "", tooltip: str = "") -> str:
    """Return a picture with a title and a caption below it; without a JPEG file, the title stands below a blank one.

    tooltip : shown if the pointer is over the title, by default the title itself
    """
    title, caption, tooltip = escape(title), escape(caption), escape(tooltip or title)
    shown = '<div class="missing">no picture</div>'
    if jpeg is not None:
        data = base64.b64encode(jpeg).decode("ascii")
        shown = f'<img src="data:image/jpeg;base64,{data}" alt="{title}">'
    return f'<figure>{shown}<figcaption><b title="{tooltip}">{title}</b>{caption}</figcaption></figure>'


def write_page(path: Path, title: str, body: Iterable[str]) -> Path:
    """Write a page with the non-empty parts of `body`, atomically.

    Raises
    ------
    ServiceError
        If the file cannot be written.
    """
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>catstream: {escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n<body>\n'
        + "\n".join(part for part in body if part)
        + "\n</body></html>\n"
    )
    with writing(path):
        write_atomically(path, page.encode(errors="surrogateescape"))
    return path
