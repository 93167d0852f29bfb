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
from catstream.video.sound import Sound

__all__ = ["VideoWriter"]

#: Steps of a video's clock per frame: how exactly a frame of a source without a constant rate keeps its time.
_TICKS_PER_FRAME = 100

#: Pixels of a picture that is still encoded for few bytes: 1920x1080 with a line of text below it.
_LARGE_PIXELS = 1920 * 1200


class VideoWriter:
    """Writes an MP4; a context manager.

    The codec is H.264 if this FFmpeg has it, else MPEG-4. The file gets its name when it is
    closed and whole; until then it is NAME.part. A run that wrote no frame
    leaves nothing, nor does one that could not write it whole: an MP4 without
    its end cannot be read.

    Parameters
    ----------
    path : of the video to write
    rate : frames per second, on average
    size : (width, height) of the frames that will come, in pixels
    sound : video file whose sound is copied beside the frames, None for no sound

    Raises
    ------
    VideoError
        If the file cannot be written, before any work is done; or takes no more, later.
    """

    def __init__(self, path: str | Path, rate: float, size: tuple[int, int], *, sound: Path | None = None) -> None:
        import av  # here, as only those who ask for a video pay for it

        self.path = Path(path)
        self.frames = 0
        self._rate = Fraction(rate).limit_denominator(1001)
        self._first_time = 0.0
        self._last_tick = -1
        self._part = self.path.with_name(self.path.name + ".part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._part.absolute()), "w", format="mp4")
        except (OSError, av.FFmpegError) as error:
            raise VideoError(
                f"cannot write the video {str(path)!r} ({error.strerror}): give a place that you may write to"
            ) from None
        h264 = "libx264" in av.codecs_available
        # Of a large picture, speed is worth more than bytes: at 3840x2160 twice as many frames per second.
        preset = "veryfast" if size[0] * size[1] <= _LARGE_PIXELS else "ultrafast"
        self._stream: Any = self._container.add_stream(
            "libx264" if h264 else "mpeg4",
            rate=self._rate,
            options={"preset": preset, "crf": "20"} if h264 else {"qscale": "3"},
        )
        self._stream.codec_context.time_base = 1 / (self._rate * _TICKS_PER_FRAME)
        self._stream.thread_count = 1  # the processes are the parallelism
        self._stream.pix_fmt = "yuv420p"
        # Both encoders share colour between 2x2 pixels, so an odd side grows by one.
        self._stream.width, self._stream.height = (side + side % 2 for side in size)
        self._sound = Sound(sound, self._container)

    def write(self, image: np.ndarray, time: float | None = None) -> None:
        """Add a frame.

        Parameters
        ----------
        image : uint8 (h, w, 3) blue green red, of the size announced
        time : seconds of the source at which it is shown; the video begins with the first of them. If None, frames
            follow one another at the rate announced
        """
        import av

        time = self.frames / float(self._rate) if time is None else time
        self._first_time = self._first_time if self.frames else time
        # Two frames never share a time stamp, whatever a source says.
        self._last_tick = max(self._last_tick + 1, round((time - self._first_time) * self._rate * _TICKS_PER_FRAME))
        down, across = self._stream.height - image.shape[0], self._stream.width - image.shape[1]
        even: Any = cv2.copyMakeBorder(image, 0, down, 0, across, cv2.BORDER_REPLICATE)
        frame = av.VideoFrame.from_ndarray(even, format="bgr24")
        frame.pts, frame.time_base = self._last_tick, self._stream.codec_context.time_base
        with self._reporting_errors():
            self._sound.copy(self._first_time, time)
            self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its name."""
        try:
            with self._reporting_errors():
                with self._container:
                    if self.frames:
                        self._container.mux(self._stream.encode(None))
                if self.frames:
                    self._part.replace(self.path)
        finally:
            self._sound.close()
            with contextlib.suppress(OSError):  # of a disk that is read-only now
                self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
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
