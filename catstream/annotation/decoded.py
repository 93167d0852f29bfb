"""The decoded frames of a video in a temporary file, which several processes read in any order."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.base.addresses import without_password
from catstream.base.arrays import UInt8
from catstream.base.files import writing
from catstream.base.settings import Settings
from catstream.errors import VideoError
from catstream.video.source import ALL_FRAMES, is_live, open_source


@dataclass(frozen=True, slots=True)
class DecodedFrames:
    """The frames of a video by number, uint8 (h, w, 3) in BGR.

    path   file with the pixels of all frames
    shape  number of frames, height, width, 3
    times  time of each frame in seconds
    rate   frames per second of the video
    name   that of the results
    """

    path: Path
    shape: tuple[int, int, int, int]
    times: tuple[float, ...]
    rate: float
    name: str

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, number: int) -> UInt8:
        frame: UInt8 = np.array(np.memmap(self.path, np.uint8, "r", shape=self.shape)[number])
        return frame  # a copy: kernels take no array that cannot be written

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame in pixels."""
        return self.shape[2], self.shape[1]


def decode(
    source: str | Path,
    folder: Path,
    settings: Settings,
    progress: Callable[[int, int | None], object],
    part: slice = ALL_FRAMES,
) -> DecodedFrames:
    """Decode a part of a file or folder once, into a file in `folder`.

    progress : called after each frame with the number of decoded frames, and of all if it is known

    Raises
    ------
    VideoError
        If the source is live or cannot be read, or if the folder has too little space: a frame takes
        3 * width * height bytes.
    """
    if is_live(source):
        raise VideoError(f"{without_password(str(source))} is live, and has no frame to return to: record it to a file")
    path, times = folder / "frames", []
    with (
        closing(open_source(source, part=part, settings=settings.run)) as video,
        writing(path, VideoError),
        path.open("wb") as file,
    ):
        width, height = video.size
        _check_space(folder, (video.frames or 0) * width * height * 3)
        for frame in video:
            file.write(frame.image.tobytes())
            times.append(frame.time)
            progress(len(times), video.frames)
        return DecodedFrames(path, (len(times), height, width, 3), tuple(times), video.rate, video.name)


def _check_space(folder: Path, required: int) -> None:
    if required > (free := shutil.disk_usage(folder).free):
        raise VideoError(
            f"the decoded frames need {required / 1e9:.1f} GB in {str(folder.parent)!r}, which has {free / 1e9:.1f} GB "
            "free: set TMPDIR to a larger disk, or cut the video into parts"
        )
