"""`Frame`, and `Source`, the base class of files and live sources."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from av import AudioStream, FFmpegError, VideoFrame, VideoStream
    from av.container import InputContainer

#: Frames per second of a source without time stamps, if none is given.
RATE = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a source.

    number  0, 1, 2 ... over the frames that the source returns; skipped frames have no number
    time    seconds since the start of the video; for a live source, the arrival time
    image   uint8 (h, w, 3), blue green red; a grey image is expanded
    pts     presentation time stamp in a live stream, in seconds of the stream's own clock; None for a file
    """

    number: int
    time: float
    image: np.ndarray
    pts: float | None = None


class Source(ABC):
    """An iterator over frames, in order and once. Close it, or use it in a `with`.

    name    name for results: the stem of a file, or the name of a folder
    rate    frames per second
    size    (width, height) of the first frame in pixels
    live    whether the source is live: frames that are not read in time are lost
    sound   video file with the sound of these frames, or None
    """

    live = False
    sound: Path | None = None

    def __init__(self, name: str, rate: float, size: tuple[int, int]) -> None:
        self.name, self.rate, self.size = name, rate, size

    @property
    def frames(self) -> int | None:
        """Number of frames of the source; None if it is unknown, as it is for a live source."""
        return None

    @property
    def counters(self) -> dict[str, float]:
        """Counters of frames that were lost, by name."""
        return {}

    def __iter__(self) -> Iterator[Frame]:
        return self

    @abstractmethod
    def __next__(self) -> Frame: ...

    @abstractmethod
    def close(self) -> None:
        """Close the source. Iteration afterwards ends at once."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class UprightConverter:
    """Converts frames that PyAV decoded to BGR arrays, and applies the rotation that phones store as metadata.

    Create one for each source: setting up the conversion costs more than the conversion of a frame.
    """

    def __init__(self) -> None:
        from av.video.reformatter import VideoReformatter

        self._reformatter = VideoReformatter()

    def __call__(self, frame: VideoFrame) -> np.ndarray:
        image = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        return np.ascontiguousarray(np.rot90(image, frame.rotation // 90))


def video_stream(container: InputContainer) -> Any:
    """Return the stream of the video, not that of a cover picture beside it; None if there is no video."""
    return container.streams.best("video")


def time_base(stream: VideoStream | AudioStream) -> Fraction:
    """Return the unit of the time stamps of a stream, in seconds. A stream that is read always has one."""
    return stream.time_base or Fraction(1)


def ffmpeg_reason(error: FFmpegError) -> str:
    """Return FFmpeg's own description of an error."""
    return (error.strerror or str(error)).lower()


def without_password(source: str) -> str:
    """Return the address of a stream without user and password, and any other source unchanged.

    >>> without_password("rtsp://me:secret@10.0.0.7/stream1")
    'rtsp://10.0.0.7/stream1'
    >>> without_password("rtsp://me:sec/ret@10.0.0.7/stream1")  # no address: the slash is not escaped
    'rtsp://10.0.0.7/stream1'
    """
    no_port = r"[^/@:\[]*:(?!\d*(/|$))"
    return re.sub(rf"(?<=://)([^/]*|{no_port}.*)@", "", source)
