"""A contact sheet as one self-contained HTML file, with a JSON file of the same content without pictures."""

from __future__ import annotations

import base64
import json
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from catstream.applications.html.page import write_page
from catstream.applications.summaries.collection import Collection, Origin
from catstream.applications.summaries.selection import Selection
from catstream.applications.summaries.taught import TaughtFrame
from catstream.errors import VideoError
from catstream.messages.storage import write_atomically

__all__ = ["Picture", "Sheet", "json_beside", "sheet_of_frames", "sheet_of_images"]


class Picture(NamedTuple):
    """A picture on the sheet.

    jpeg     JPEG file, None if the picture cannot be shown
    title    first line below it
    caption  second line
    """

    jpeg: bytes | None
    title: str
    caption: str


@dataclass(frozen=True, slots=True)
class Sheet:
    """The content of a contact sheet.

    about     paragraphs below the title
    pictures  in the order in which they are shown
    figures   content of the JSON file
    """

    title: str
    about: tuple[str, ...]
    pictures: list[Picture]
    figures: dict[str, Any]

    def save(self, path: Path) -> None:
        """Write the HTML file, and the JSON file beside it, each atomically.

        Raises
        ------
        VideoError
            If a file cannot be written.
        """
        paragraphs = (f'<p class="about">{escape(text)}</p>' for text in self.about)
        heading = f"<h1>{escape(self.title)}</h1>"
        write_page(
            path, self.title, [heading, *paragraphs, '<div class="pictures">', *map(_figure, self.pictures), "</div>"]
        )
        try:
            write_atomically(json_beside(path), (json.dumps(self.figures, indent=1) + "\n").encode())
        except OSError as error:
            raise VideoError(f"cannot write {str(json_beside(path))!r}: {error.strerror}") from None


def json_beside(path: Path) -> Path:
    """Return the path of the JSON file that belongs to an HTML file."""
    return path.with_suffix(".json")


def sheet_of_images(name: str, collection: Collection, selection: Selection[tuple[Origin, bytes]]) -> Sheet:
    """Return the sheet of the images that were selected from a collection, each with its JPEG, in their order there."""
    places = {each: place for place, each in enumerate(collection.names)}
    rows = sorted(selection.rows, key=lambda row: (places[row.key[0].file], row.key[0].frame or 0))
    skipped = f"; {len(collection.skipped)} could not be read" * bool(collection.skipped)
    return Sheet(
        f"Summary of {name}",
        (
            f"{len(rows)} of {selection.count} images keep {100 * selection.kept:.1f} % of the energy of all{skipped}.",
            "An image adds the energy that is not kept by the selected images which add more.",
        ),
        [Picture(row.key[1], row.key[0].file, _caption(row.key[0], row.energy)) for row in rows],
        {
            "images": selection.count,
            "kept": selection.kept,
            "kept_at_most": selection.kept_at_most,
            "skipped": collection.skipped,
            "selected": [asdict(row.key[0]) | {"energy": row.energy} for row in rows],
        },
    )


def sheet_of_frames(
    name: str, frames: list[TaughtFrame], measured: int, source: str, pictures: dict[int, bytes]
) -> Sheet:
    """Return the sheet of the frames that taught the tracker most, of so many that were measured."""
    return Sheet(
        f"Summary of {name}",
        (
            f"The {len(frames)} of {measured} frames that taught the tracker most, spread over the run.",
            "New is the share of the energy of the object's rows that the coreset did not span before the frame. The "
            "box is the one that was learned from.",
        ),
        [
            Picture(
                pictures.get(each.frame), f"frame {each.frame}", f"{each.time:.2f} s; {100 * each.novelty:.1f} % new"
            )
            for each in frames
        ],
        {"frames": measured, "source": source, "selected": [asdict(frame) for frame in frames]},
    )


def _caption(origin: Origin, energy: float) -> str:
    place = "" if origin.time is None else f"frame {origin.frame}, {origin.time:.2f} s; "
    return f"{place}adds {100 * energy:.2f} %"


def _figure(picture: Picture) -> str:
    title, caption = escape(picture.title), escape(picture.caption)
    shown = '<div class="missing">no picture</div>'
    if picture.jpeg is not None:
        data = base64.b64encode(picture.jpeg).decode("ascii")
        shown = f'<img src="data:image/jpeg;base64,{data}" alt="{title}">'
    return f'<figure>{shown}<figcaption><b title="{title}">{title}</b>{caption}</figcaption></figure>'
