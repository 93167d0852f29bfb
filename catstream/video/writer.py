"""Videos written frame by frame."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from catstream.errors import VideoError

__all__ = ["VideoWriter"]


class VideoWriter:
    """Writes an MP4; a context manager.

    H.264 where this FFmpeg can, else MPEG-4. The file gets its name when it is
    closed and whole; until then it is NAME.part. A run that wrote no frame
    leaves nothing, nor does one that could not write it whole: an MP4 without
    its end cannot be read.

    Parameters
    ----------
    path : of the video to write
    rate : frames a second
    size : (width, height) of the frames that will come

    Raises
    ------
    VideoError
        Where the file cannot be written, before any work is done; or takes no more, later.
    """

    def __init__(self, path: str | Path, rate: float, size: tuple[int, int]) -> None:
        import av  # here, as only those who ask for a video pay for it

        self.path = Path(path)
        self.frames = 0
        self._part = self.path.with_name(self.path.name + ".part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._part.absolute()), "w", format="mp4")
        except (OSError, av.FFmpegError) as error:
            raise VideoError(
                f"cannot write the video {str(path)!r} ({error.strerror}): give a place that you may write to"
            ) from None
        h264 = "libx264" in av.codecs_available
        self._stream: Any = self._container.add_stream(
            "libx264" if h264 else "mpeg4",
            rate=Fraction(rate).limit_denominator(60000),
            options={"preset": "veryfast", "crf": "20"} if h264 else {"qscale": "3"},
        )
        self._stream.thread_count = 1  # the processes are the parallelism
        self._stream.pix_fmt = "yuv420p"
        # Both encoders share colour between 2x2 pixels, so an odd side grows by one.
        self._stream.width, self._stream.height = (side + side % 2 for side in size)

    def write(self, image: np.ndarray) -> None:
        """Add a frame, uint8 (h, w, 3) blue green red, of the size announced."""
        import av

        down, across = self._stream.height - image.shape[0], self._stream.width - image.shape[1]
        even: Any = cv2.copyMakeBorder(image, 0, down, 0, across, cv2.BORDER_REPLICATE)
        with self._to_disk():
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(even, format="bgr24")))
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its name."""
        try:
            with self._to_disk():
                with self._container:
                    if self.frames:
                        self._container.mux(self._stream.encode(None))
                if self.frames:
                    self._part.replace(self.path)
        finally:
            with contextlib.suppress(OSError):  # of a disk that is read-only now
                self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _to_disk(self) -> Iterator[None]:
        import av

        try:
            yield
        except (OSError, av.FFmpegError) as error:
            self.frames = 0  # as nothing can be read: to write on to such a file ends the process
            raise VideoError(f"cannot write the video {str(self.path)!r} any more: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
