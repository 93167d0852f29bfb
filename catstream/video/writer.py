"""Writes videos frame by frame, to a file or to a server."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from time import monotonic
from typing import Any

import cv2
import numpy as np

from catstream.errors import VideoError

#: Steps of the video's time base per frame: the precision of time stamps if the frame rate is not constant.
_TICKS_PER_FRAME = 100

#: The largest image, in pixels, that is encoded with the slower preset: 1920x1080 with a line of text below it.
_LARGE_PIXELS = 1920 * 1200


class VideoWriter(contextlib.AbstractContextManager["VideoWriter"]):
    """Writes an MP4; a context manager, which leaves no file if an error or Ctrl-C ends its block.

    The codec is H.264 if this FFmpeg has it, else MPEG-4. The file is NAME.part until it is closed. If no frame was
    written, or writing failed, no file is left: an MP4 without its index cannot be read.

    The rate is the average of frames per second. VideoError, also from the constructor, if the file cannot be written.
    """

    def __init__(
        self, path: str | Path, rate: float, size: tuple[int, int], *, pixel_aspect: Fraction = Fraction(1)
    ) -> None:
        import av  # imported here because only the writing of videos needs it

        self.path = Path(path)
        self.frames = 0
        self._rate = Fraction(rate).limit_denominator(1001) or Fraction(1, 1001)
        self._first_time = 0.0
        self._last_tick = -1
        self._part = self.path.with_name(self.path.name + ".part")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._part.absolute()), "w", format="mp4")
        except (OSError, av.FFmpegError) as error:
            raise VideoError(
                f"cannot write the video {str(path)!r} ({error.strerror}): give a path that you may write to"
            ) from None
        h264 = "libx264" in av.codecs_available
        # Large images use the faster preset: at 3840x2160 it encodes twice as many frames per second.
        preset = "veryfast" if size[0] * size[1] <= _LARGE_PIXELS else "ultrafast"
        self._stream: Any = self._container.add_stream(
            "libx264" if h264 else "mpeg4",
            rate=self._rate,
            options={"preset": preset, "crf": "20"} if h264 else {"qscale": "3"},
        )
        self._stream.codec_context.time_base = 1 / (self._rate * _TICKS_PER_FRAME)
        self._stream.thread_count = 1  # the processes of the pipeline already use the cores
        self._stream.pix_fmt = "yuv420p"
        # Both encoders subsample colour by 2x2 pixels, so an odd side is padded by one pixel.
        self._stream.width, self._stream.height = (side + side % 2 for side in size)
        self._stream.codec_context.sample_aspect_ratio = pixel_aspect

    def write(self, image: np.ndarray, time: float | None = None) -> None:
        """Add a frame, uint8 (h, w, 3), blue green red, of the size given to the constructor.

        The first time stamp, in seconds of the source, is the start of the video. Without them, the rate is constant.
        """
        time = self.frames / float(self._rate) if time is None else time
        self._first_time = self._first_time if self.frames else time
        # Time stamps must increase, even if those of the source do not.
        self._last_tick = max(self._last_tick + 1, round((time - self._first_time) * self._rate * _TICKS_PER_FRAME))
        frame = _frame(image, self._stream, self._last_tick)
        with self._reporting_errors():
            self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its final name."""
        try:
            with self._reporting_errors():
                with self._container:
                    if self.frames:
                        self._container.mux(self._stream.encode(None))
                if self.frames:
                    self._part.replace(self.path)
        finally:
            with contextlib.suppress(OSError):  # the disk may have become read-only
                self._part.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        import av

        try:
            yield
        except (OSError, av.FFmpegError) as error:
            self.frames = 0  # the file is unreadable; writing more to it would crash the process
            raise VideoError(f"cannot write the video {str(self.path)!r} any more: {error.strerror}") from None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.frames = 0
        self.close()


class LiveWriter:
    """Pushes pictures to an RTSP or RTMP server as H.264, each at the time at which it is written; close it.

    FFmpeg blocks all threads of the process while it connects to a server, and `write` blocks while the server is slow.
    VideoError from the constructor if this FFmpeg has no encoder, from `write` if the server does not take a picture.
    """

    def __init__(self, address: str, size: tuple[int, int]) -> None:
        import av

        if "libx264" not in av.codecs_available:
            raise VideoError("this FFmpeg has no encoder for H.264: install the package av from PyPI")
        rtsp = address.startswith("rtsp")
        # TCP, which passes firewalls and loses nothing; the time-out is in microseconds.
        options = {"rtsp_transport": "tcp", "timeout": "3000000"} if rtsp else {}
        self._container = av.open(address, "w", format="rtsp" if rtsp else "flv", container_options=options)
        # A key frame in every 20 pictures: a viewer who joins waits for one.
        encoding = {"preset": "veryfast", "tune": "zerolatency", "crf": "23", "g": "20"}
        self._stream: Any = self._container.add_stream("libx264", rate=10, options=encoding)
        self._stream.codec_context.time_base = Fraction(1, 1000)
        self._stream.thread_count, self._stream.pix_fmt = 1, "yuv420p"
        self._stream.width, self._stream.height = (side + side % 2 for side in size)
        self._started, self._last_tick = monotonic(), -1

    def write(self, image: np.ndarray) -> None:
        """Push a picture, uint8 (h, w, 3), blue green red, of the size given to the constructor."""
        import av

        self._last_tick = max(self._last_tick + 1, round(1000 * (monotonic() - self._started)))
        try:
            self._container.mux(self._stream.encode(_frame(image, self._stream, self._last_tick)))
        except (OSError, av.FFmpegError) as error:
            raise VideoError((error.strerror or str(error)).lower()) from None

    def close(self) -> None:
        import av

        with contextlib.suppress(OSError, av.FFmpegError):
            self._container.close()


def _frame(image: np.ndarray, stream: Any, tick: int) -> Any:
    """Return an image as a frame of a stream, at this tick of its time base. An odd side is padded by one pixel."""
    import av

    down, across = stream.height - image.shape[0], stream.width - image.shape[1]
    even: Any = cv2.copyMakeBorder(image, 0, down, 0, across, cv2.BORDER_REPLICATE)
    frame = av.VideoFrame.from_ndarray(even, format="bgr24")
    frame.pts, frame.time_base = tick, stream.codec_context.time_base
    return frame
