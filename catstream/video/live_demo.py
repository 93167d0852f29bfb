"""The demo video as a live source, which needs no camera and never ends.

    demo:3                          320 x 240 pixels, 25 frames per second
    demo:3?size=640x480&rate=10

The number is a seed: it selects one of six parts of the demo video, and the sensor noise. Each part has 5 s and shows
the object in its first image; it is shown forwards, backwards, and so on. An image is rendered when it is due for the
first time, and kept in memory. `first_box` gives the box of the object in the first image.

As for a camera, frames that are not read in time are skipped and counted. Unlike a camera, the video begins when its
first frame is read, so the box of the first image fits whenever the source is opened. If a run is resumed, it begins
with the image of the number of its next frame.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import monotonic
from urllib.parse import parse_qsl

import numpy as np

from catstream.box import Box
from catstream.errors import VideoError
from catstream.video import demo
from catstream.video.frames import RATE, Frame, Source

#: Sources that begin with this are live demos.
PREFIX = "demo:"

_SIZE = (320, 240)
_SMALLEST, _LARGEST = 64, 1920  # width and height of a frame, in pixels
_FASTEST = 200.0  # frames per second
_IMAGES = 125  # different images of a part
_BEGINS = (0, 60, 120, 290, 340, 390)  # first images of the parts, in which the object is whole and not occluded
_IDLE_SECONDS = 0.1


@dataclass(frozen=True, slots=True)
class _Parameters:
    """The parameters in the address of a live demo."""

    seed: int
    size: tuple[int, int] = _SIZE
    rate: float = RATE

    @property
    def begin(self) -> int:
        """Number of the first image in the demo video."""
        return _BEGINS[self.seed % len(_BEGINS)]

    @classmethod
    def parse(cls, text: str) -> _Parameters:
        seed, _, query = text.removeprefix(PREFIX).partition("?")
        values = dict(parse_qsl(query, keep_blank_values=True))
        size = re.fullmatch(r"(\d{1,5})x(\d{1,5})", values.pop("size", f"{_SIZE[0]}x{_SIZE[1]}"))
        rate = re.fullmatch(r"\d{1,4}(\.\d{1,6})?", values.pop("rate", str(RATE)))
        if not re.fullmatch(r"\d{1,9}", seed) or values or size is None or rate is None:
            raise VideoError(f"{text!r} is not a live demo: expected demo:SEED, or demo:SEED?size=640x480&rate=25")
        width, height = int(size[1]), int(size[2])
        if not all(_SMALLEST <= side <= _LARGEST for side in (width, height)) or not 0 < float(rate[0]) <= _FASTEST:
            raise VideoError(
                f"{text!r} is outside the limits of a live demo: {_SMALLEST} to {_LARGEST} pixels a side, and up to "
                f"{_FASTEST:g} frames per second"
            )
        return cls(int(seed), (width, height), float(rate[0]))


def first_box(text: str) -> Box:
    """The box of the object in the first image of a live demo, in whole pixels.

    >>> first_box("demo:1")
    Box(x=184.0, y=88.0, w=57.0, h=58.0)
    """
    chosen = _Parameters.parse(text)
    first = demo.render(1, chosen.size, begin=chosen.begin)  # in which the object is visible
    (box,) = (box for _, box in first if box is not None)
    return Box(*(float(round(value)) for value in box))


class LiveDemo(Source):
    """The newest frame of the demo video at each iteration. `catstream.video.source.open_source` opens one.

    Attributes
    ----------
    skipped : number of frames that were not read before the next one was due

    Raises
    ------
    VideoError
        From the constructor, if the text names no live demo.
    """

    live = True

    def __init__(
        self, text: str, start: int = 0, *, since: float | None = None, idle: Callable[[], bool] | None = None
    ) -> None:
        chosen = _Parameters.parse(text)
        super().__init__(f"demo-{chosen.seed}", chosen.rate, chosen.size)
        self.skipped = 0
        self._chosen = chosen
        self._images: dict[int, np.ndarray] = {}  # that were rendered, by number
        self._first = self._number = start
        self._zero, self._idle = since, idle
        self._opened: float | None = None  # time at which the first frame was read
        self._last = start - 1  # image of the last frame
        self._closed = threading.Event()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`, as for a camera."""
        return {"skipped": self.skipped}

    def __next__(self) -> Frame:
        if self._closed.is_set():
            raise StopIteration
        if self._opened is None:
            self._image(self._first)
            self._opened = monotonic()
        while (left := self._due(self._last + 1) - monotonic()) > 0:
            self._closed.wait(min(left, _IDLE_SECONDS))
            if self._closed.is_set() or (left > _IDLE_SECONDS and self._idle is not None and self._idle()):
                raise StopIteration
        return self._frame(monotonic(), self._opened)

    def close(self) -> None:
        self._closed.set()
        self._images.clear()

    def _due(self, image: int) -> float:
        """The time at which an image is due."""
        return (self._opened or 0.0) + (image - self._first) / self.rate

    def _frame(self, now: float, opened: float) -> Frame:
        """The newest image that is due."""
        newest = max(self._last + 1, self._first + int((now - opened) * self.rate))
        self.skipped += newest - self._last - 1
        self._zero = now if self._zero is None else self._zero
        frame = Frame(self._number, max(0.0, now - self._zero), self._image(newest).copy())
        self._last, self._number = newest, self._number + 1
        return frame

    @cached_property
    def _demo(self) -> demo.Demo:
        """Made for the first image: a source may be opened without being read."""
        return demo.Demo(self._chosen.size, self._chosen.seed, begin=self._chosen.begin)

    def _image(self, number: int) -> np.ndarray:
        """An image of the endless video: forwards, then backwards, and so on."""
        last = _IMAGES - 1
        shown = last - abs(number % (2 * last) - last)
        if shown not in self._images:
            self._images[shown] = self._demo.image(shown)[0]
        return self._images[shown]
