"""Writes a contact sheet: one self-contained HTML file with small pictures and a caption below each."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from pathlib import Path

from catstream.html.page import write_page

__all__ = ["Picture", "write_sheet"]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture on the sheet.

    jpeg     JPEG file, None if the picture cannot be shown
    title    name of the image, in the first line below it
    caption  text in the second line
    """

    jpeg: bytes | None
    title: str
    caption: str


def write_sheet(path: Path, title: str, about: Iterable[str], pictures: Iterable[Picture]) -> Path:
    """Write a contact sheet.

    Parameters
    ----------
    about : paragraphs below the title

    Raises
    ------
    VideoError
        If the file cannot be written.
    """
    paragraphs = (f'<p class="about">{escape(text)}</p>' for text in about)
    return write_page(
        path,
        title,
        [f"<h1>{escape(title)}</h1>", *paragraphs, '<div class="pictures">', *map(_figure, pictures), "</div>"],
    )


def _figure(picture: Picture) -> str:
    title, caption = escape(picture.title), escape(picture.caption)
    shown = '<div class="missing">no picture</div>'
    if picture.jpeg is not None:
        data = base64.b64encode(picture.jpeg).decode("ascii")
        shown = f'<img src="data:image/jpeg;base64,{data}" alt="{title}">'
    return f'<figure>{shown}<figcaption><b title="{title}">{title}</b>{caption}</figcaption></figure>'
