"""Frames, and what every source of them has, whether it is a recording or live."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

__all__ = ["RATE", "Frame", "Source", "UprightConverter", "ffmpeg_reason", "without_password"]

#: Frames per second of a source without a clock, if none is given.
RATE = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a source.

    number  0, 1, 2 ... of the frames that the source gives, which are not all of a live one, or of a part
    time    seconds since the start of the video; of a live source, when this frame came
    image   uint8 (h, w, 3), blue green red; grey is expanded
    pts     time stamp of the frame in a live stream, seconds of a clock of the stream's own; None of a file
    """

    number: int
    time: float
    image: np.ndarray
    pts: float | None = None


class Source(ABC):
    """Frames in order, once, and what is known of them before they are read.

    name    what results are called: the stem of a file, the name of a folder
    rate    frames per second
    size    (width, height) of the first frame in pixels
    live    whether frames pass by whether they are read or not
    sound   video file whose sound belongs to the frames; None if there is none

    Close it, or use it in a `with`.
    """

    live = False
    sound: Path | None = None

    def __init__(self, name: str, rate: float, size: tuple[int, int]) -> None:
        self.name, self.rate, self.size = name, rate, size

    @property
    def frames(self) -> int | None:
        """Number of frames that the source has; None if that cannot be known, as of a live source."""
        return None

    @property
    def counters(self) -> dict[str, float]:
        """Counts of the frames that a source has lost: name -> number."""
        return {}

    def __iter__(self) -> Iterator[Frame]:
        return self

    @abstractmethod
    def __next__(self) -> Frame: ...

    @abstractmethod
    def close(self) -> None:
        """Let the source go. Iterating afterwards ends at once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class UprightConverter:
    """Images of frames that PyAV decoded: phones store upright videos lying down, and the turn beside them.

    One for each source: to begin a conversion costs more than to convert.
    """

    def __init__(self) -> None:
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()

    def __call__(self, frame: Any) -> np.ndarray:
        image = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        return np.ascontiguousarray(np.rot90(image, frame.rotation // 90))


def ffmpeg_reason(error: Any) -> str:
    """What FFmpeg says went wrong, in its words."""
    return (error.strerror or str(error)).lower()


def without_password(source: str) -> str:
    """The address of a stream without its user and password; any other source as it is.

    >>> without_password("rtsp://me:secret@10.0.0.7/stream1")
    'rtsp://10.0.0.7/stream1'
    """
    return re.sub(r"(?<=://)[^/]*@", "", source)
