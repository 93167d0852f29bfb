"""Live sources: cameras and network streams. Always the newest frame; what is lost is opened again, for ever.

A thread reads and decodes whatever comes and keeps the newest frame, so that who takes frames slowly gets few of them,
and never old ones: the rest are counted. Where nothing comes for a while, or the stream ends or breaks, the
source is closed and opened anew, after pauses that double, until it is back or nobody wants it any more.
"""

from __future__ import annotations

import contextlib
import logging
import random
import re
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

import cv2

from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason, without_password

__all__ = ["LiveSource"]

#: Time-outs: to open a source and get its first frame, and from a frame to the next.
_OPEN_SECONDS, _SILENT_SECONDS = 10.0, 5.0
_FIRST_PAUSE, _LONGEST_PAUSE = 0.25, 8.0
_IDLE_SECONDS = 0.1

_OPTIONS = {
    # Over UDP a lost packet is a damaged picture; a camera that knows no TCP is still heard.
    "rtsp": {"rtsp_flags": "prefer_tcp", "analyzeduration": "500000"},
    "http": {"analyzeduration": "500000"},
}

_log = logging.getLogger(__name__)


class LiveSource(Source):
    """The newest frame of a camera or a stream, each time one is asked for; see `catstream.video.source.open_source`.

    Iterating waits for a frame that was not taken yet. Should the source come back with other
    pixels, its frames are scaled to the size of the first one.

    Attributes
    ----------
    skipped : frames that came and were not taken, as a newer one came
    reopened : how often it was lost and came back

    Raises
    ------
    VideoError
        From the constructor, where it cannot be opened and no `idle` was given; never later.
    """

    live = True

    def __init__(
        self, text: str, start: int = 0, *, since: float | None = None, idle: Callable[[], bool] | None = None
    ) -> None:
        super().__init__(_name(text), RATE, (0, 0))
        self.skipped = self.reopened = 0
        self._text, self._address = text, without_password(text)
        self._number, self._zero, self._idle = start, since, idle
        self._upright = UprightConverter()
        self._condition = threading.Condition()  # guards what follows
        self._newest: tuple[float, Any] | None = None
        self._problem = ""  # why it is lost, empty while it is not
        self._last_frame_time = monotonic()  # when the last frame came
        self._closed = False
        self._was_open = idle is not None  # without it, a source that never was there is an error, and not lost
        self._thread = threading.Thread(target=self._read, name=f"reader of {self.name}", daemon=True)
        self._thread.start()
        self._first: Frame | None = None
        if idle is None:
            self._first = self._first_frame()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`, `reopened`, and `lost_seconds`: how long it has been lost, 0 while it is not."""
        silent = monotonic() - self._last_frame_time
        # A device that hangs is beyond every time-out of FFmpeg: at least it is said.
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
        # One that is frozen is not waited for: its thread ends with its time-out, or with the process.
        self._thread.join(1.0)

    def _first_frame(self) -> Frame:
        """The first frame, or a VideoError: where a source was never there, its name is more likely wrong."""
        while (newest := self._wait_for_newest()) is None:
            if self._problem:
                self.close()
                hint = f"; the folder of that name is ./{self._text}" if self._text.isdigit() else ""
                raise VideoError(
                    f"cannot open {self._address!r} ({self._problem}): check that it is there and running, "
                    f"and its address{hint}"
                )
        return self._frame(*newest)

    def _wait_for_newest(self) -> tuple[float, Any] | None:
        """The newest frame and when it came, None where none comes for a moment."""
        with self._condition:
            if self._newest is None and not self._closed:
                self._condition.wait(_IDLE_SECONDS)
            newest, self._newest = self._newest, None
        return newest

    def _frame(self, moment: float, decoded: Any) -> Frame:
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
        """Keep the newest frame, of one opening after the other."""
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
            except Exception as error:  # whatever it is: nobody would notice a thread that is gone
                problem = str(error)
            if monotonic() - max(opened, self._last_frame_time) >= _SILENT_SECONDS:
                problem = "no picture comes"  # FFmpeg has many words for a time-out, and none of them says so
            with self._condition:
                self._report_loss(problem)
                self._condition.wait_for(lambda: self._closed, pause * random.uniform(0.5, 1))
            pause = min(2 * pause, _LONGEST_PAUSE)

    def _decoded(self) -> Iterator[Any]:
        """Frames of one opening, up to its end; those that came damaged are left out."""
        import av

        with _open_container(self._text) as container:
            stream = container.streams.video[0]
            stream.thread_type = "NONE"  # the processes are the parallelism
            self.rate = float(stream.average_rate or stream.guessed_rate or RATE)
            due = monotonic() + _OPEN_SECONDS
            for packet in container.demux(stream):
                if self._closed or monotonic() > due:  # of a packet that a time-out ended, half is missing
                    return
                decoded: list[Any] = []
                with contextlib.suppress(av.FFmpegError):  # of a damaged packet; the next may be whole
                    decoded = stream.codec_context.decode(packet)
                for frame in decoded:
                    if not frame.is_corrupt:
                        due = monotonic() + _SILENT_SECONDS
                        yield frame

    def _store_newest(self, moment: float, decoded: Any) -> None:
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
        """Say why, where that is news: a source may be away for days."""
        if problem != self._problem and self._was_open and not self._closed:
            _log.warning("the source %s is lost (%s), and is opened again until it is back", self.name, problem)
        self._problem = problem


def _open_container(text: str) -> Any:
    """Open a camera or a stream; raises what PyAV raises, and VideoError where it holds no live picture."""
    import av

    kind = urlsplit(text).scheme.rstrip("s")
    where = f"/dev/video{text}" if text.isdigit() else text
    container = av.open(
        where,
        format=None if kind else "v4l2",
        options=_OPTIONS.get(kind, {}),
        timeout=(_OPEN_SECONDS, _SILENT_SECONDS),
    )
    problem = ""
    if not container.streams.video or container.streams.video[0].codec_context is None:
        problem = "there is no picture in it"
    elif kind == "http" and container.duration:
        problem = f"it is a recording of {container.duration / 1e6:.0f} s: fetch it, and give the file"
    if problem:
        container.close()
        raise VideoError(problem)
    return container


def _name(text: str) -> str:
    """What results are called: the last word of the address, else the host; without user and password.

    >>> [_name(text) for text in ("0", "/dev/video2", "rtsp://me:secret@10.0.0.7:554/cam/one.sdp?x=1", "http://10.0.0.7")]
    ['video0', 'video2', 'one', '10.0.0.7']
    """
    if text.isdigit():
        return f"video{text}"
    address = urlsplit(text)
    word = address.path.rstrip("/").rpartition("/")[2]
    word = word.partition(".")[0] or address.hostname or "live"
    return re.sub(r"[^\w.-]", "_", word)
