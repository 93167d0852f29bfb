"""The decoded frames of a video in a temporary file, which several processes read in any order."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.base.arrays import UInt8
from catstream.base.files import writing
from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.video.frames import Source


@dataclass(frozen=True, slots=True)
class DecodedFrames:
    """The frames of a video by number, uint8 (h, w, 3) in BGR: those that `decode` has written so far.

    path   file with the pixels of all frames
    size   width and height of a frame in pixels
    times  time of each frame in seconds
    rate   frames per second of the video
    name   name of the results
    count  file to which a byte is appended for each frame that is read; without it, reading is an OSError
    """

    path: Path
    size: tuple[int, int]
    times: list[float]
    rate: float
    name: str
    count: Path | None = None

    def __len__(self) -> int:
        return len(self.times)

    def size_of(self, number: int) -> tuple[int, int]:  # noqa: ARG002  # of first frames, each has its own
        """Width and height of a frame in pixels."""
        return self.size

    def __getitem__(self, number: int) -> UInt8:
        if self.count is not None:
            file = os.open(self.count, os.O_WRONLY | os.O_APPEND)
            os.write(file, b".")
            os.close(file)
        width, height = self.size
        pixels = 3 * height * width
        return np.fromfile(self.path, np.uint8, pixels, offset=number * pixels).reshape(height, width, 3)


def decode(video: Source, frames: DecodedFrames, progress: Callable[[int, int | None], object]) -> None:
    """Decode all frames once, into their file, and close the video.

    progress : called after each frame with the number of decoded frames, and of all if it is known

    Raises
    ------
    VideoError
        If a frame cannot be decoded; those before it are there. If the disk has too little space: a frame takes
        3 * width * height bytes.
    """
    with closing(video), writing(frames.path, VideoError), frames.path.open("wb") as file:
        width, height = frames.size
        _check_space(frames.path.parent, (video.frames or 0) * width * height * 3)
        try:
            for frame in video:
                file.write(frame.image.tobytes())
                file.flush()  # before its number is counted
                frames.times.append(frame.time)
                progress(len(frames), video.frames)
        except VideoError as error:
            raise VideoError(f"{counted(len(frames), 'frame')} could be read: {error}") from None


def _check_space(folder: Path, required: int) -> None:
    if required > (free := shutil.disk_usage(folder).free):
        raise VideoError(
            f"not enough space for the decoded frames in {str(folder.parent)!r} ({required / 1e9:.1f} GB required, "
            f"{free / 1e9:.1f} GB free): set TMPDIR to a larger disk, or split the video"
        )
