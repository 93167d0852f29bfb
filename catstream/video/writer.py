"""Encodes images as H.264, and writes them to an MP4 file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from catstream.base.files import open_locked
from catstream.errors import VideoError

#: Ticks of the time base per frame: the precision of time stamps at a variable frame rate.
_TICKS_PER_FRAME = 100

#: Seconds between keyframes, at the average rate.
_KEYFRAME_SECONDS = 2

#: The largest image, in pixels, that is encoded with the slower preset: 1920x1080 with a line of text below it.
_LARGE_PIXELS = 1920 * 1200

#: Fragments of a second, which `close` turns into a regular MP4 with one index.
_OPTIONS = {"movflags": "hybrid_fragmented", "frag_duration": "1000000", "flush_packets": "1"}


class Encoder:
    """Encodes images as H.264 without delay: each image results in one packet, which refers to the one before it.

    Packets are for the PyAV output `container`, to which a stream is added; without a container, they are access units
    in Annex B format. `rate` is the average of frames per second, `size` the width and height of the images. VideoError
    if this FFmpeg has no encoder.
    """

    def __init__(
        self, size: tuple[int, int], rate: float, container: Any = None, *, pixel_aspect: Fraction = Fraction(1)
    ) -> None:
        import av  # a slow import, for writing only

        if "libx264" not in av.codecs_available:
            raise VideoError("PyAV lacks the H.264 encoder libx264: pip install --force-reinstall av")
        self._rate = Fraction(rate).limit_denominator(1001) or Fraction(1, 1001)
        self._first_time, self._last_tick = 0.0, -1
        if container is None:
            self._context: Any = av.CodecContext.create("libx264", "w")
            self._encode = self._context.encode
        else:
            stream = container.add_stream("libx264", rate=self._rate)
            self._context, self._encode = stream.codec_context, stream.encode
        self._context.framerate, self._context.time_base = self._rate, 1 / (self._rate * _TICKS_PER_FRAME)
        # Colour is subsampled by 2x2 pixels, so an odd side is padded by one pixel.
        self._context.width, self._context.height = (side + side % 2 for side in size)
        self._context.pix_fmt, self._context.sample_aspect_ratio = "yuv420p", pixel_aspect
        self._context.thread_count = 1  # the processes of the pipeline already use the cores
        self._context.options = {
            # At 3840x2160, the faster preset encodes twice as many frames per second.
            "preset": "veryfast" if size[0] * size[1] <= _LARGE_PIXELS else "ultrafast",
            "tune": "zerolatency",
            "crf": "22",
            "g": str(max(1, round(_KEYFRAME_SECONDS * self._rate))),
        }

    def packets(self, image: np.ndarray, time: float | None = None) -> list[Any]:
        """Return the packets of an image, uint8 (h, w, 3), blue green red.

        The first `time`, in seconds, is the start of the stream; without times, the rate is constant.
        """
        import av

        is_first = self._last_tick < 0
        if time is None:
            tick = self._last_tick + (1 if is_first else _TICKS_PER_FRAME)
        else:
            self._first_time = time if is_first else self._first_time
            tick = round((time - self._first_time) * self._rate * _TICKS_PER_FRAME)
        self._last_tick = max(self._last_tick + 1, tick)  # ticks must increase, even if the times do not
        down, across = self._context.height - image.shape[0], self._context.width - image.shape[1]
        even: Any = cv2.copyMakeBorder(image, 0, down, 0, across, cv2.BORDER_REPLICATE)
        frame = av.VideoFrame.from_ndarray(even, format="bgr24")
        frame.pts, frame.time_base = self._last_tick, self._context.time_base
        return list(self._encode(frame))

    def flush(self) -> list[Any]:
        """Return the last packets."""
        return list(self._encode(None))


class VideoWriter(contextlib.AbstractContextManager["VideoWriter"]):
    """Writes images as H.264 to an MP4 file.

    It grows by fragments of a second: if the process is killed or the disk is full, it is readable up to the last one.
    Its folder is created, and it is locked until it is closed. The file is removed if it has no frame, or if its `with`
    block is left by an error or Ctrl-C.

    path : file, which is replaced
    rate : average of frames per second
    size : width and height of the images in pixels

    VideoError, also from the constructor, if the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        rate: float,
        size: tuple[int, int],
        *,
        pixel_aspect: Fraction = Fraction(1),
    ) -> None:
        import av

        self._path, self.frames, self._has_failed = Path(path).absolute(), 0, False
        with self._reporting_errors():
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._container: Any = av.open(str(self._path), "w", format="mp4", container_options=_OPTIONS)
            self._encoder = Encoder(size, rate, self._container, pixel_aspect=pixel_aspect)
            # FFmpeg opens the file once more, for the first image.
            self._lock = open_locked(self._path, VideoError, mode="ab")

    def write(self, image: np.ndarray, time: float | None = None) -> None:
        """Add a frame, uint8 (h, w, 3), blue green red, of the size given to the constructor; times as in `Encoder`."""
        with self._reporting_errors():
            self._container.mux(self._encoder.packets(image, time))
        self.frames += 1

    def close(self) -> None:
        """Complete the file."""
        try:
            with self._reporting_errors():
                if self.frames and not self._has_failed:  # a failed container crashes the process
                    self._container.mux(self._encoder.flush())
                self._container.close()
        finally:
            self._lock.close()
            if not self.frames:
                with contextlib.suppress(OSError):  # the disk may have become read-only
                    self._path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        import av

        try:
            yield
        except (OSError, av.FFmpegError) as error:
            self._has_failed = True
            raise VideoError(f"cannot write the video {self._path}: {error.strerror}") from error

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.frames = 0
        self.close()
