"""Live sources: cameras and network streams. They give the newest frame, and reconnect after a loss, without limit.

A thread reads and decodes continuously and keeps only the newest frame. A slow consumer therefore gets fewer frames,
never old ones; the skipped frames are counted. If no frame arrives within a time-out, or the stream ends or fails, the
source is closed and reopened with exponential backoff until it is back or the consumer closes it.
"""

from __future__ import annotations

import contextlib
import logging
import random
import re
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import TYPE_CHECKING

import cv2

from catstream.errors import VideoError
from catstream.video.frames import (
    RATE,
    Frame,
    Source,
    UprightConverter,
    ffmpeg_reason,
    video_stream,
    without_password,
)

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

#: Time-outs for opening a source and its first frame, and between two frames.
_OPEN_SECONDS, _SILENT_SECONDS = 10.0, 5.0
_FIRST_PAUSE, _LONGEST_PAUSE = 0.25, 8.0
_IDLE_SECONDS = 0.1

_OPTIONS = {
    # TCP first, because over UDP a lost packet damages the picture; a camera without TCP is still received over UDP.
    "rtsp": {"rtsp_flags": "prefer_tcp", "analyzeduration": "500000"},
    "http": {"analyzeduration": "500000"},
}

_log = logging.getLogger(__name__)


class LiveSource(Source):
    """A camera or a stream; each iteration gives its newest frame. `catstream.video.source.open_source` opens one.

    Iteration waits for a frame that was not returned yet. If the source reconnects with another image size, its frames
    are scaled to the size of the first one. VideoError from the constructor, if the source cannot be opened and no
    `idle` was given; never later.
    """

    live = True

    def __init__(self, text: str, start: int, *, since: float | None, idle: Callable[[], bool] | None) -> None:
        super().__init__(_name(text), RATE, (0, 0))
        self.skipped = self.reopened = 0
        self._text, self._address = text, without_password(text)
        self._number, self._zero, self._idle = start, since, idle
        self._upright = UprightConverter()
        self._condition = threading.Condition()  # guards the fields below
        self._newest: tuple[float, VideoFrame] | None = None
        self._problem = ""  # why the source is lost; empty while it is not
        self._last_frame_time = monotonic()
        self._closed = False
        self._was_open = idle is not None  # without `idle`, a source that was never open is an error and not a loss
        self._thread = threading.Thread(target=self._read, name=f"reader of {self.name}", daemon=True)
        self._thread.start()
        self._first: Frame | None = None
        if idle is None:
            self._first = self._first_frame()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`: frames that were replaced by a newer one before they were returned; `reopened`: number of times
        that the source came back; `lost_seconds`: seconds since it was lost, 0 while it is not."""
        silent = monotonic() - self._last_frame_time
        # FFmpeg has no time-out for a device that hangs, so a long silence counts as a loss too.
        lost = silent if self._problem or silent > _OPEN_SECONDS else 0.0
        return {"skipped": self.skipped, "reopened": self.reopened, "lost_seconds": lost}

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        while (newest := self._wait_for_newest()) is None:
            if self._closed or (self._idle is not None and self._idle()):
                raise StopIteration
        return self._frame(*newest)

    def close(self) -> None:
        with self._condition:
            self._closed, self._first, self._newest = True, None, None
            self._condition.notify_all()
        # The thread of a device that hangs is not waited for: it ends with its time-out or with the process.
        self._thread.join(1.0)

    def _first_frame(self) -> Frame:
        """Return the first frame. Raises VideoError at the first failure, because the address is probably wrong."""
        while (newest := self._wait_for_newest()) is None:
            if self._problem:
                self.close()
                hint = f"; the folder of that name is ./{self._text}" if self._text.isdigit() else ""
                problem, _, advice = self._problem.partition(": ")  # what to do about it, if that is known
                advice = advice or f"check that it is running, and its address{hint}"
                raise VideoError(f"cannot open {self._address!r} ({problem}): {advice}")
        return self._frame(*newest)

    def _wait_for_newest(self) -> tuple[float, VideoFrame] | None:
        """Return the newest frame and its arrival time, or None if no frame arrives within `_IDLE_SECONDS`."""
        with self._condition:
            if self._newest is None and not self._closed:
                self._condition.wait(_IDLE_SECONDS)
            newest, self._newest = self._newest, None
        return newest

    def _frame(self, moment: float, decoded: VideoFrame) -> Frame:
        image = self._upright(decoded)
        size = image.shape[1], image.shape[0]
        self.size = self.size if any(self.size) else size
        if size != self.size:
            image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
        self._zero = moment if self._zero is None else self._zero
        frame = Frame(self._number, max(0.0, moment - self._zero), image, decoded.time)
        self._number += 1
        return frame

    # --- the thread ------------------------------------------------------------------------------

    def _read(self) -> None:
        """Read frames and keep the newest; reconnect after each loss."""
        import av

        pause = _FIRST_PAUSE
        while not self._closed:
            opened, problem = monotonic(), "it ended"
            try:
                for decoded in self._decoded():
                    self._store_newest(monotonic(), decoded)
                    pause = _FIRST_PAUSE
            except av.FFmpegError as error:
                problem = ffmpeg_reason(error)
            except Exception as error:  # an unexpected error must not end the thread silently
                problem = str(error)
            if monotonic() - max(opened, self._last_frame_time) >= _SILENT_SECONDS:
                problem = "no frame arrives"  # FFmpeg's messages for a time-out are unclear
            with self._condition:
                self._report_loss(problem)
                self._condition.wait_for(lambda: self._closed, pause * random.uniform(0.5, 1))
            pause = min(2 * pause, _LONGEST_PAUSE)

    def _decoded(self) -> Iterator[VideoFrame]:
        """Yield the undamaged frames of one connection, until it ends."""
        import av

        with _open_container(self._text) as container:
            stream = video_stream(container)
            stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
            self.rate = float(stream.average_rate or stream.guessed_rate or RATE)
            due = monotonic() + _OPEN_SECONDS
            for packet in container.demux():
                if self._closed or monotonic() > due:  # a packet that was cut off by a time-out is incomplete
                    return
                if packet.stream_index != stream.index:  # sound may go on while the picture does not
                    continue
                decoded: list[VideoFrame] = []
                with contextlib.suppress(av.FFmpegError):  # the packet is damaged; the next may be whole
                    decoded = stream.codec_context.decode(packet)
                for frame in decoded:
                    if not frame.is_corrupt:
                        due = monotonic() + _SILENT_SECONDS
                        yield frame

    def _store_newest(self, moment: float, decoded: VideoFrame) -> None:
        with self._condition:
            if self._closed:
                return
            if self._problem:
                self.reopened += 1
                _log.warning("the source %s is back after %.1f s", self.name, moment - self._last_frame_time)
            self.skipped += self._newest is not None
            self._newest, self._last_frame_time, self._problem, self._was_open = (moment, decoded), moment, "", True
            self._condition.notify()

    def _report_loss(self, problem: str) -> None:
        """Log the reason of a loss, once for each reason: a source may be lost for days."""
        if problem != self._problem and self._was_open and not self._closed:
            _log.warning("the source %s is lost (%s); it is reopened until it is back", self.name, problem)
        self._problem = problem


def _open_container(text: str) -> InputContainer:
    """Open a camera or a stream. Raises PyAV's errors, and VideoError if it has no live video."""
    import av

    kind = text.partition(":")[0].lower().rstrip("s") if "://" in text else ""
    container = av.open(
        f"/dev/video{text}" if text.isdigit() else text,
        format=None if kind else "v4l2",
        options=_OPTIONS.get(kind, {}),
        timeout=(_OPEN_SECONDS, _SILENT_SECONDS),
        metadata_errors="replace",
    )
    problem = ""
    if video_stream(container) is None:
        problem = "it has no video"
    elif kind == "http" and container.duration:
        problem = f"it is a recording of {container.duration / 1e6:.0f} s: download it, and give the file"
    if problem:
        container.close()
        raise VideoError(problem)
    return container


def _name(text: str) -> str:
    """Return the name for results: the last part of the address, or the host; without user and password.

    >>> [_name(text) for text in ("0", "/dev/video2", "rtsp://me:sec[ret@10.0.0.7:554/cam/one.sdp?x=1", "http://10.0.0.7")]
    ['video0', 'video2', 'one', '10.0.0.7']
    """
    if text.isdigit():
        return f"video{text}"
    # By hand: urlsplit raises ValueError for a bracket in a password.
    host, _, path = re.sub(r"^\w+://|[?#].*", "", without_password(text)).partition("/")
    word = path.rstrip("/").rpartition("/")[2].partition(".")[0]
    word = word or re.sub(r":\d+$", "", host).strip("[]").lower() or "live"
    return re.sub(r"[^\w.-]", "_", word)
