"""A contact sheet as one self-contained HTML file, with a JSON file of the same content without pictures."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from catstream.applications.html.page import figure, write_page
from catstream.applications.summaries.collection import Collection, Origin
from catstream.applications.summaries.selection import Selection
from catstream.applications.summaries.taught import TaughtFrame
from catstream.errors import VideoError
from catstream.messages.storage import write_atomically, writing
from catstream.video.annotate import thumbnail
from catstream.video.frames import without_password
from catstream.video.source import is_live, open_source

#: Width of a picture in pixels.
WIDTH = 420

_TOLERANCE_SECONDS = 1e-3
_NO_BOX = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class Sheet:
    """The content of a contact sheet.

    about     paragraphs below the title
    pictures  HTML elements in the order in which they are shown
    figures   content of the JSON file
    """

    title: str
    about: tuple[str, ...]
    pictures: list[str]
    figures: dict[str, Any]

    def save(self, path: Path) -> None:
        """Write the HTML file, and the JSON file beside it, each atomically.

        Raises
        ------
        ServiceError
            If a file cannot be written.
        """
        paragraphs = (f'<p class="about">{escape(text)}</p>' for text in self.about)
        heading = f"<h1>{escape(self.title)}</h1>"
        write_page(path, self.title, [heading, *paragraphs, '<div class="pictures">', *self.pictures, "</div>"])
        with writing(json_beside(path)):
            write_atomically(json_beside(path), json.dumps(self.figures, indent=1).encode(), b"\n")


def json_beside(path: Path) -> Path:
    """Return the path of the JSON file that belongs to an HTML file."""
    return path.with_suffix(".json")


def sheet_of_images(name: str, collection: Collection, selection: Selection[tuple[Origin, bytes]]) -> Sheet:
    """Return the sheet of the images that were selected from a collection, each with its JPEG, in their order there."""
    places = {each: place for place, each in enumerate(collection.names)}
    images = [(*key, energy) for key, energy in zip(selection.selected, selection.energies, strict=True)]
    images.sort(key=lambda image: (places[image[0].file], image[0].frame or 0))
    skipped = f"; {len(collection.skipped)} could not be read" * bool(collection.skipped)
    pictures = []
    for origin, jpeg, energy in images:
        place = "" if origin.time is None else f"frame {origin.frame}, {origin.time:.2f} s; "
        pictures.append(figure(jpeg, origin.file, f"{place}adds {100 * energy:.2f} %"))
    return Sheet(
        f"Summary of {name}",
        (
            f"{len(images)} of {selection.count} images keep {100 * selection.kept:.1f} % of the energy of "
            f"all{skipped}.",
            "An image adds the energy that is not kept by the selected images which add more.",
        ),
        pictures,
        {
            "images": selection.count,
            "kept": selection.kept,
            "kept_at_most": selection.kept_at_most,
            "skipped": collection.skipped,
            "selected": [asdict(origin) | {"energy": energy} for origin, _, energy in images],
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
            figure(
                pictures.get(each.frame), f"frame {each.frame}", f"{each.time:.2f} s; {100 * each.novelty:.1f} % new"
            )
            for each in frames
        ],
        {"frames": measured, "source": source, "selected": [asdict(frame) for frame in frames]},
    )


def pictures_of(frames: list[TaughtFrame], source: str, image_rate: float) -> dict[int, bytes]:
    """Read frames of a source, with the object's box drawn in.

    The frames are found by their time, because the frames of a run are numbered from its first one.

    Returns
    -------
    JPEG files by the number of the frame

    Raises
    ------
    VideoError
        If the source is live, cannot be read, or has no frame at one of these times.
    """
    if is_live(source):
        raise VideoError(f"{without_password(source)!r} is a live source, and its frames were not kept")
    found: dict[int, bytes] = {}
    waiting = sorted(frames, key=lambda frame: -frame.time)
    with open_source(source, image_rate=image_rate, skip_damaged=True, resize=True) as images:
        for image in images:
            while waiting and waiting[-1].time < image.time - _TOLERANCE_SECONDS:
                waiting.pop()
            if waiting and abs(waiting[-1].time - image.time) <= _TOLERANCE_SECONDS:
                frame = waiting.pop()
                box = _NO_BOX if frame.box is None else np.array(frame.box, np.float64)
                found[frame.frame] = thumbnail(image.image, _NO_BOX, box, WIDTH)
            if not waiting:
                break
    if missing := len(frames) - len(found):
        raise VideoError(f"{missing} of {len(frames)} frames are not in {source!r}: it is not the video of this run")
    return found
