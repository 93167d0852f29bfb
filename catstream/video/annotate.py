"""Tracks drawn over their frames, for people to look at."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from catstream.messages import Track
from catstream.video.writer import VideoWriter

__all__ = ["AnnotatedVideo", "draw", "thumbnail"]

#: Blue, green, red.
_COLOURS = {"present": (110, 220, 60), "bootstrapping": (40, 180, 250), "absent": (90, 90, 240)}
_WHITE, _GREY, _ORANGE = (245, 245, 245), (110, 110, 110), (40, 140, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX

#: Images narrower than this are enlarged by a whole factor, so that the text can be read.
_READABLE = 320


def draw(image: np.ndarray, track: Track) -> np.ndarray:
    """Draw box, state, score and model version over a copy of a frame.

    Parameters
    ----------
    image : uint8 (h, w, 3), blue green red
    track : what was found in it

    Returns
    -------
    uint8 (k h, k w, 3), where k is 1 unless the image is narrower than 320 pixels
    """
    zoom = _zoom(image.shape[1])
    canvas = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC) if zoom > 1 else image.copy()
    unit = canvas.shape[1] / 640  # lengths below are pixels of an image 640 wide
    colour = _COLOURS[track.state]
    if track.box is not None:
        x, y, w, h = (value * zoom for value in track.box)
        _frame(canvas, (x, y), (x + w, y + h), colour, unit)
    _strip(canvas, track, colour, max(unit, 0.75))
    return canvas


def thumbnail(image: np.ndarray, truth: np.ndarray, box: np.ndarray, width: int) -> bytes:
    """A small picture of a frame with two boxes, the true one white, the other orange.

    Parameters
    ----------
    image : uint8 (h, w, 3), blue green red
    truth, box : float64 (4,), x, y, w, h; not drawn where NaN
    width : of the picture in pixels

    Returns
    -------
    JPEG
    """
    scale = width / image.shape[1]
    small = cv2.resize(image, (width, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    for rectangle, colour in ((truth, _WHITE), (box, _ORANGE)):
        if np.isfinite(rectangle).all():
            x, y, w, h = (float(value) * scale for value in rectangle)
            corners = (round(x), round(y)), (round(x + w), round(y + h))
            cv2.rectangle(small, *corners, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.rectangle(small, *corners, colour, 1, cv2.LINE_AA)
    return cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 80))[1].tobytes()


def _zoom(width: int) -> int:
    return max(1, -(-_READABLE // width))


def _frame(canvas: np.ndarray, start: Any, end: Any, colour: Any, unit: float) -> None:
    """A thin rectangle with strong corners, over a dark one, so that it shows on any background."""
    (left, top), (right, bottom) = (tuple(round(value) for value in corner) for corner in (start, end))
    thin, arm = max(1, round(1.2 * unit)), min(right - left, bottom - top) // 4
    cv2.rectangle(canvas, (left, top), (right, bottom), (0, 0, 0), thin + 2, cv2.LINE_AA)
    cv2.rectangle(canvas, (left, top), (right, bottom), colour, thin, cv2.LINE_AA)
    for x, way in ((left, 1), (right, -1)):
        for y, down in ((top, 1), (bottom, -1)):
            corner = np.array([(x + way * arm, y), (x, y), (x, y + down * arm)], np.int32)
            cv2.polylines(canvas, [corner], False, colour, max(2, round(3 * unit)), cv2.LINE_AA)


def _strip(canvas: np.ndarray, track: Track, colour: Any, unit: float) -> None:
    """A dark line of text along the bottom: state, score as bar and number, model and frame."""
    height, width = canvas.shape[:2]
    tall = round(26 * unit)
    canvas[-tall:] = canvas[-tall:] // 4
    middle, line = height - tall // 2, height - round(9 * unit)

    def write(text: str, left: int, shade: Any) -> None:
        cv2.putText(canvas, text, (left, line), _FONT, 0.45 * unit, shade, max(1, round(unit)), cv2.LINE_AA)

    cv2.circle(canvas, (round(14 * unit), middle), round(5 * unit), colour, cv2.FILLED, cv2.LINE_AA)
    write(track.state, round(26 * unit), _WHITE)
    left, long, half = round(132 * unit), round(90 * unit), max(2, round(3 * unit))
    full = round(long * min(max(track.score, 0.0), 1.0))
    cv2.rectangle(canvas, (left, middle - half), (left + long, middle + half), _GREY, cv2.FILLED)
    cv2.rectangle(canvas, (left, middle - half), (left + full, middle + half), colour, cv2.FILLED)
    write(f"{track.score:.2f}", left + long + round(8 * unit), _WHITE)
    end = f"model {track.model_version}   frame {track.frame}"
    (wide, _), _ = cv2.getTextSize(end, _FONT, 0.45 * unit, max(1, round(unit)))
    write(end, width - wide - round(10 * unit), _WHITE)


class AnnotatedVideo:
    """An MP4 of frames with their tracks drawn in; a context manager.

    See `catstream.video.writer.VideoWriter`, which it writes with.

    Parameters
    ----------
    path : of the video to write
    rate : frames a second
    size : (width, height) of the frames that will come

    Raises
    ------
    VideoError
        Where the file cannot be written, before any work is done.
    """

    def __init__(self, path: str | Path, rate: float, size: tuple[int, int]) -> None:
        zoom = _zoom(size[0])
        self._writer = VideoWriter(path, rate, (size[0] * zoom, size[1] * zoom))

    def write(self, image: np.ndarray, track: Track) -> None:
        """Add a frame, uint8 (h, w, 3) of the size announced, with its track."""
        self._writer.write(draw(image, track))

    def close(self) -> None:
        """Finish the file and give it its name."""
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
