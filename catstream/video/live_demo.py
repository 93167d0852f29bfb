"""The demo video as a live source, `demo:SEED`, which needs no camera and never ends.

It has 320 x 240 pixels, and `run.image_rate` frames per second. The seed is a number: it selects the sensor noise. Five
seconds of the video play forwards, backwards, and so on; an image is rendered at its first use, and cached.

As with a camera, frames that are not read in time are skipped and counted. Unlike a camera, the video begins when its
first frame is read, so `first_box` is right whenever the source is opened. A resumed run begins with the image that
has the number of its next frame.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from functools import cached_property
from time import monotonic
from typing import cast

import numpy as np

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.video import rendered
from catstream.video.frames import IDLE_SECONDS, Frame, Source

#: Sources that begin with this are live demos.
PREFIX = "demo:"

_SIZE = (320, 240)
_BEGIN, _IMAGES = 60, 125  # first of the images in the demo video, and their number


def _seed(text: str) -> int:
    if not re.fullmatch(r"demo:\d{1,9}", text):
        raise VideoError(f"{text!r} is not a live demo: expected demo:SEED, for example demo:1")
    return int(text.removeprefix(PREFIX))


def first_box(text: str) -> Box:
    """The box of the object in the first image of a live demo, in whole pixels.

    >>> first_box("demo:1")
    Box(x=184.0, y=88.0, w=57.0, h=58.0)
    """
    _, box = rendered.Demo(_SIZE, _seed(text)).image(_BEGIN)
    return Box(*(float(round(value)) for value in cast(Box, box)))


class LiveDemo(Source):
    """The newest frame of the demo video at each iteration. `catstream.video.source.open_source` opens one."""

    live = True

    def __init__(
        self, text: str, start: int, rate: float, *, since: float | None, idle: Callable[[], bool] | None
    ) -> None:
        self._seed = _seed(text)
        super().__init__(f"demo-{self._seed}", rate, _SIZE)
        self._images: dict[int, np.ndarray] = {}  # rendered ones, by number
        self._start = self._number = start
        self.zero, self._idle = since, idle
        self._opened: float | None = None  # time at which the first frame was read
        self._last = start - 1  # number of the last image
        self._closed = threading.Event()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`, the number of frames that were not read in time."""
        return {"skipped": self._last + 1 - self._number}

    def __next__(self) -> Frame:
        if self._opened is None:
            self._image(self._start)
            self._opened = monotonic()
        next_time = self._opened + (self._last + 1 - self._start) / self.rate
        while not self._closed.is_set() and (seconds := next_time - monotonic()) > 0:
            self._closed.wait(min(seconds, IDLE_SECONDS))
            if seconds > IDLE_SECONDS and self._idle is not None and self._idle():
                raise StopIteration
        if self._closed.is_set():
            raise StopIteration
        now = monotonic()
        self.zero = now if self.zero is None else self.zero
        self._last = max(self._last + 1, self._start + int((now - self._opened) * self.rate))
        self._number += 1
        image = self._image(self._last).copy()
        return Frame(self._number - 1, max(0.0, now - self.zero), image, self._last / self.rate)

    def close(self) -> None:
        self._closed.set()
        self._images.clear()

    @cached_property
    def _demo(self) -> rendered.Demo:
        """Created for the first image, because a source may be opened without being read."""
        return rendered.Demo(_SIZE, self._seed)

    def _image(self, number: int) -> np.ndarray:
        """An image of the endless video: forwards, then backwards, and so on."""
        last = _IMAGES - 1
        index = last - abs(number % (2 * last) - last)
        if index not in self._images:
            self._images[index], _ = self._demo.image(_BEGIN + index)
        return self._images[index]
