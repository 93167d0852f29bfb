"""Draws tracks over their frames, and assigns each object a colour."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.video.frames import jpeg
from catstream.wire.messages import Preview, Track

#: Colours as #rrggbb: distinguishable for colour-blind people, and light enough for dark text on them. In a picture,
#: outline each with a dark line, which is visible on a light background.
PALETTE = (
    "#ff922b", "#3586ff", "#fedd38", "#e123c2", "#bae0b4", "#fd0304", "#76c6fe", "#5a8667", "#b7a59c",
)  # fmt: skip

#: Blue, green, red.
_Point = tuple[float, float]
_Colour = tuple[int, int, int]

_COLOURS: dict[str, _Colour] = {"present": (110, 220, 60), "bootstrapping": (40, 180, 250), "absent": (90, 90, 240)}
_WHITE, _DARK, _BLACK = (245, 245, 245), (32, 32, 32), (17, 17, 17)
_FONT = cv2.FONT_HERSHEY_SIMPLEX

#: Height of the line of text below an image that is 640 pixels wide, and the smallest factor by which it is scaled.
_TEXT_HEIGHT, _MIN_UNIT = 26, 0.75


class Colours:
    """Assigns each object a colour, which does not change until the object is dropped.

    A new object gets the first of the least used colours.

    >>> colours = Colours()
    >>> [colours.of(name) for name in ("anna", "ben", "anna")]
    ['#ff922b', '#3586ff', '#ff922b']
    >>> colours.keep(["ben"])
    >>> colours.of("carl")
    '#ff922b'
    """

    def __init__(self) -> None:
        self._colours: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Return the colour of an object as #rrggbb."""
        if name not in self._colours:
            used = Counter(self._colours.values())
            self._colours[name] = min(PALETTE, key=lambda colour: used[colour])
        return self._colours[name]

    def keep(self, names: Iterable[str]) -> None:
        """Drop all objects except these; new objects reuse their colours."""
        self._colours = {name: self._colours[name] for name in self._colours.keys() & set(names)}


def draw(image: np.ndarray, tracks: Sequence[Track], colours: Colours) -> np.ndarray:
    """Draw the boxes over a copy of a frame, and a line of text below it.

    A single unnamed object is drawn in the colour of its state. Otherwise, each object has its own colour, and its name
    at its box. The scores are below the frame.

    The image is uint8 (h, w, 3), blue green red, the result uint8 (h + k, w, 3) with k rows for the text. There is at
    least one track; `colours` has the colours of earlier frames.
    """
    height, width = image.shape[:2]
    unit = max(width / 640, _MIN_UNIT)
    canvas = np.zeros((height + _text_height(width), width, 3), np.uint8)
    picture = canvas[:height]
    picture[:] = image
    is_alone = [track.object for track in tracks] == [UNNAMED]
    drawn = [(track, _COLOURS[track.state] if is_alone else _bgr(colours.of(track.object))) for track in tracks]
    for track, colour in drawn:
        if track.box is not None:
            x, y, w, h = track.box
            _draw_box(picture, (x, y), (x + w, y + h), colour, width / 640)
    for track, colour in drawn:  # over all boxes
        if track.box is not None:
            _draw_name(picture, track, colour, unit)
    _draw_scores(canvas[height:], drawn, unit)
    return canvas


def drawn_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return the width and height of the image that `draw` returns for a frame of this width and height."""
    width, height = size
    return width, height + _text_height(width)


def draw_preview(preview: Preview, tracks: Sequence[Track], colours: Colours) -> bytes:
    """Draw the tracks of a frame and a line of text into its preview, and return a JPEG file."""
    image = preview_image(preview, tracks, colours)
    return preview.jpeg if image is None else jpeg(image)


def preview_image(preview: Preview, tracks: Sequence[Track], colours: Colours) -> np.ndarray | None:
    """Return the image of `draw_preview`, uint8 (h, w, 3), blue green red; None if the preview cannot be decoded."""
    image = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    if not tracks:
        return np.vstack([image, np.full((_text_height(image.shape[1]), image.shape[1], 3), _DARK, np.uint8)])
    scale = image.shape[1] / preview.width
    boxes = [track.box and Box(*(side * scale for side in track.box)) for track in tracks]
    return draw(image, [replace(track, box=box) for track, box in zip(tracks, boxes, strict=True)], colours)


def outline(image: np.ndarray, box: Box, colour: str, unit: float = 1.0) -> None:
    """Draw a box into an image, in a colour #rrggbb; `unit` is the width of its lines, about one pixel."""
    _draw_box(image, (box.x, box.y), (box.x + box.w, box.y + box.h), _bgr(colour), unit)


def _bgr(colour: str) -> _Colour:
    """Return blue, green and red of a colour #rrggbb."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return blue, green, red


def _text_height(width: int) -> int:
    """Return the height in pixels of the line of text below an image of this width."""
    return round(_TEXT_HEIGHT * max(width / 640, _MIN_UNIT))


def _draw_box(canvas: np.ndarray, start: _Point, end: _Point, colour: _Colour, unit: float) -> None:
    """Draw a thin rectangle with thick corners over a dark outline, so that it is visible on any background."""
    (left, top), (right, bottom) = (tuple(round(value) for value in corner) for corner in (start, end))
    thin, arm = max(1, round(1.2 * unit)), min(right - left, bottom - top) // 4
    cv2.rectangle(canvas, (left, top), (right, bottom), (0, 0, 0), thin + 2, cv2.LINE_AA)
    cv2.rectangle(canvas, (left, top), (right, bottom), colour, thin, cv2.LINE_AA)
    for x, across in ((left, 1), (right, -1)):
        for y, down in ((top, 1), (bottom, -1)):
            corner = np.array([(x + across * arm, y), (x, y), (x, y + down * arm)], np.int32)
            cv2.polylines(canvas, [corner], False, colour, max(2, round(3 * unit)), cv2.LINE_AA)


def _draw_name(canvas: np.ndarray, track: Track, colour: _Colour, unit: float) -> None:
    """Write the name of an object in black letters on its colour: above its box, or in it if there is no room above."""
    if not track.object or track.box is None:
        return
    height, width = canvas.shape[:2]
    scale, thick, margin = 0.45 * unit, max(1, round(unit)), max(2, round(3 * unit))
    text = _plain(track.object)
    (text_width, ascent), descent = cv2.getTextSize(text, _FONT, scale, thick)
    label_width, label_height = text_width + 2 * margin, ascent + descent + margin
    left = min(max(round(track.box.x), 0), max(width - label_width, 0))
    top = round(track.box.y) - label_height
    top = min(max(top if top >= 0 else round(track.box.y), 0), height - label_height)
    cv2.rectangle(canvas, (left, top), (left + label_width, top + label_height), colour, cv2.FILLED)
    baseline = (left + margin, top + ascent + margin // 2 + 1)
    cv2.putText(canvas, text, baseline, _FONT, scale, _BLACK, thick, cv2.LINE_AA)


def _plain(text: str) -> str:
    """Remove accents, and replace letters that OpenCV's fonts lack by question marks."""
    letters = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(letters).encode("ascii", "replace").decode()


def _text_width(text: str, unit: float) -> int:
    return cv2.getTextSize(text, _FONT, 0.45 * unit, max(1, round(unit)))[0][0]


def _write(canvas: np.ndarray, text: str, left: int, unit: float) -> None:
    baseline = (left, canvas.shape[0] - round(9 * unit))
    cv2.putText(canvas, text, baseline, _FONT, 0.45 * unit, _WHITE, max(1, round(unit)), cv2.LINE_AA)


def _draw_scores(canvas: np.ndarray, drawn: Sequence[tuple[Track, _Colour]], unit: float) -> None:
    """Write the name (or state) and score of each object, and the frame number.

    A disc marks a present object, a ring an absent one. Without enough room, the number of omitted objects follows.
    """
    width = canvas.shape[1]
    canvas[:] = _DARK
    middle, gap, left = canvas.shape[0] // 2, round(12 * unit), round(8 * unit)
    end = f"frame {drawn[0][0].frame}"
    right = width - _text_width(end, unit) - gap
    if right > left:
        _write(canvas, end, right, unit)
    for count, (track, colour) in enumerate(drawn):
        text, rest = f"{_plain(track.object) or track.state} {track.score:.2f}", f"+{len(drawn) - count}"
        is_last = count == len(drawn) - 1
        if left + gap + _text_width(text, unit) + (0 if is_last else gap + _text_width(rest, unit)) > right - gap:
            if left + _text_width(rest, unit) < right:
                _write(canvas, rest, left, unit)
            return
        disc = cv2.FILLED if track.box is not None else max(1, round(unit))
        cv2.circle(canvas, (left + round(4 * unit), middle), round(4 * unit), colour, disc, cv2.LINE_AA)
        _write(canvas, text, left + gap, unit)
        left += 2 * gap + _text_width(text, unit)
