"""Live sources: cameras and network streams. They return the newest frame, and reconnect after a loss, without limit.

A thread reads and decodes continuously and stores only the newest frame. A slow consumer therefore gets fewer frames,
never old ones; the skipped frames are counted. If no frame arrives within a timeout, or the stream ends or fails, the
source reconnects with exponential backoff until it succeeds or the consumer closes it. The timeouts apply to frames: a
camera that sends audio but no video also counts as lost. `catstream.video.reconnect` decides how to connect again.

HTTP has two special cases. The address of a still picture is polled. HLS delivers segments of some seconds at once;
their frames are returned at the pace of their time stamps.
"""

from __future__ import annotations

import logging
import math
import random
import re
import threading
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING

import cv2

from catstream.base.addresses import without_password
from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.connection import ENDED, INVALID, LONGEST_SEGMENT, Connection, loss_of, modes_of
from catstream.video.frames import IDLE_SECONDS, RATE, Frame, Source, UprightConverter
from catstream.video.reconnect import Attempt, Loss, next_attempt

if TYPE_CHECKING:
    from av import VideoFrame

_POLL_SECONDS = 1.0  # between two requests of a still picture, which cameras update about as often
_LONGEST_PLAYLIST = 60.0  # seconds
_QUIET_SECONDS = 600.0  # between two log lines with the same reason

_log = logging.getLogger(__name__)


class LiveSource(Source):
    """A camera or a stream; each iteration returns its newest frame. `catstream.video.source.open_source` opens one.

    Iteration waits for a frame that was not returned yet. If the source reconnects with another image size, its frames
    are scaled to the size of the first one. Without `idle`, the constructor raises VideoError if the source cannot be
    opened; iteration never does.
    """

    live = True

    def __init__(
        self,
        text: str,
        start: int,
        settings: RunSettings,
        *,
        since: float | None,
        rate: float | None,
        idle: Callable[[], bool] | None,
    ) -> None:
        super().__init__(_name(text), rate or RATE, (0, 0))
        self.zero = since
        self._number = start  # of the next frame
        self._idle = idle
        self._upright = UprightConverter()
        # Without `idle`, a first failure is an error, not a loss.
        self._reader = Reader(text, settings, rate, Outages(self.name, is_open=idle is not None))
        self._first: Frame | None = None  # read by the constructor
        if idle is None:
            self._first = self._first_frame()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`: frames that were replaced by a newer one before they were returned, or dropped by `Backlog`;
        `reconnects`: successful reconnections; `lost_seconds`: seconds since the source was lost, 0 while it is
        connected. It is absent before the first frame or failure: a detector that was restarted does not know it
        yet."""
        outages, settings = self._reader.outages, self._reader.settings
        counters: dict[str, float] = {"skipped": self._reader.skipped, "reconnects": outages.reconnects}
        # FFmpeg has no timeout for a device that hangs, so a long silence also counts as a loss.
        lost = outages.lost_seconds(settings.open_timeout_seconds + settings.read_timeout_seconds + _POLL_SECONDS)
        return counters if lost is None else counters | {"lost_seconds": lost}

    def __next__(self) -> Frame:
        if self._first is not None:
            frame, self._first = self._first, None
            return frame
        while (newest := self._reader.wait()) is None:
            if self._reader.closed.is_set() or (self._idle is not None and self._idle()):
                raise StopIteration
        return self._frame(*newest)

    def close(self) -> None:
        self._first = None
        self._reader.close()

    def _first_frame(self) -> Frame:
        """Return the first frame. Raises VideoError at the first failure, because the address is probably wrong."""
        while (newest := self._reader.wait()) is None:
            if self._reader.outages.problem:
                self.close()
                text = self._reader.text
                problem, _, advice = self._reader.outages.problem.partition(": ")
                if re.search("40[13]", problem):
                    cause = "its user and password"
                elif "://" in text:
                    cause = "that it is running, and its address"
                else:
                    cause = "that the camera is connected (ls /dev/video*)"
                folder = f"; the folder of that name is ./{text}" if text.isdigit() else ""
                address = without_password(text)
                raise VideoError(f"cannot open {address!r} ({problem}): {advice or f'check {cause}{folder}'}")
        return self._frame(*newest)

    def _frame(self, moment: float, decoded: VideoFrame) -> Frame:
        self.rate = self._reader.rate or self.rate
        image = self._upright(decoded)
        size = image.shape[1], image.shape[0]
        self.size = self.size if any(self.size) else size
        if size != self.size:
            image = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
        self.zero = moment if self.zero is None else self.zero
        frame = Frame(self._number, max(0.0, moment - self.zero), image, decoded.time)
        self._number += 1
        return frame


class Reader:
    """The thread of a live source. It stores the newest frame, and reconnects after each loss until it is closed."""

    def __init__(self, text: str, settings: RunSettings, rate: float | None, outages: Outages) -> None:
        protocol, mark, path = text.partition("://")
        self.text = protocol.lower() + mark + path  # FFmpeg's names of protocols are in lower case
        self.settings = settings
        self.rate = rate  # frames per second, None until a connection has measured them
        self.outages = outages
        self.skipped = 0  # frames that were replaced or dropped
        self.closed = threading.Event()
        self._segment_time = -math.inf  # time stamp of the last frame of a segment
        self._segment_moment = 0.0  # at which it was to be returned
        self._newest: tuple[float, VideoFrame] | None = None  # with its arrival time; guarded by the condition
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"reader of {outages.name}", daemon=True)
        self._thread.start()

    def wait(self) -> tuple[float, VideoFrame] | None:
        """Return the newest frame and its arrival time, or None if no frame arrives within `IDLE_SECONDS`."""
        with self._changed:
            if self._newest is None and not self.closed.is_set():
                self._changed.wait(IDLE_SECONDS)
            newest, self._newest = self._newest, None
        return None if self.closed.is_set() else newest

    def close(self) -> None:
        with self._changed:
            self.closed.set()
            self._changed.notify_all()
        # The thread of a device that hangs is not waited for: it ends with its timeout or with the process.
        self._thread.join(1.0)

    def _run(self) -> None:
        modes, begin = modes_of(self.text, self.settings), monotonic()
        attempt = Attempt(modes[0])
        while True:
            loss = self._connect(attempt, begin)
            if self.closed.is_set():
                return
            attempt = next_attempt(attempt, loss, modes)
            if attempt.begin == "at once":  # within the time of the first attempt, unless that was a success
                begin = monotonic() if loss.frames else begin
                continue
            if attempt.begin == "poll":
                wait = begin + _POLL_SECONDS - monotonic()
            else:
                wait = attempt.backoff * random.uniform(0.5, 1)
                self.outages.begin(loss.reason.replace(self.text, without_password(self.text)), monotonic())
            self.closed.wait(max(0.0, wait))
            begin = monotonic()

    def _connect(self, attempt: Attempt, begin: float) -> Loss:
        """Connect once, and store the frames until the connection is lost."""
        frames, connection = 0, Connection(self.text, self.settings, attempt, begin, self.rate)
        try:
            for frame in connection.frames():
                self.rate = connection.rate
                if self.closed.is_set():
                    break
                if frame is None:
                    self.skipped += 1
                elif not connection.is_segmented or self._is_next(frame):
                    self._store(frame)
                    frames += 1
        except Exception as error:  # an unexpected error must not end the thread silently
            silence = monotonic() - max(begin, self.outages.last_frame)
            return loss_of(error, frames, silence, self.settings.read_timeout_seconds)
        if attempt.mode == "jpegs" and not frames:  # an HTML page, for example
            return Loss("invalid", frames, INVALID)
        return Loss("ended", frames, ENDED)

    def _is_next(self, frame: VideoFrame) -> bool:
        """Wait until a frame of a segment is to be returned. Returns False if it was returned before."""
        time, now = frame.time or 0.0, monotonic()
        ahead = time - self._segment_time
        if -_LONGEST_PLAYLIST < ahead <= 0:
            return False
        # The time stamps of the next segment may begin again.
        self._segment_moment = max(now, self._segment_moment + ahead) if 0 < ahead < LONGEST_SEGMENT else now
        self._segment_time = time
        self.closed.wait(self._segment_moment - now)
        return True

    def _store(self, decoded: VideoFrame) -> None:
        with self._changed:
            now = monotonic()
            self.outages.end(now)
            self.skipped += self._newest is not None
            self._newest = now, decoded
            self._changed.notify()


class Outages:
    """When and why a source is lost. Each is logged, but a reason at most once in ten minutes: it may last for days."""

    def __init__(self, name: str, *, is_open: bool) -> None:
        self.name = name
        self.problem = ""  #: why the source is lost; empty while it is connected
        self.last_frame = monotonic()  #: arrival of the last frame; before the first one, the start
        self.reconnects = 0  #: number of outages that have ended
        self._was_open = is_open  # whether a failure is a loss
        self._has_frame = False
        self._is_logged = False  # whether this outage was logged
        self._log_times: dict[str, float] = {}  # of the last log line with each reason

    def begin(self, problem: str, now: float) -> None:
        """Note that the source is lost, or still lost."""
        if self._was_open and now - self._log_times.get(problem, -math.inf) > _QUIET_SECONDS:
            _log.warning("lost source %s (%s); reconnecting", self.name, problem)
            self._log_times[problem] = now
            self._is_logged = True
        self.problem = problem

    def end(self, now: float) -> None:
        """Note that a frame has arrived."""
        if self.problem:
            self.reconnects += 1
            if self._is_logged:
                _log.warning("reconnected to source %s after %.1f s", self.name, now - self.last_frame)
        self.last_frame, self.problem = now, ""
        self._has_frame, self._was_open, self._is_logged = True, True, False

    def lost_seconds(self, limit: float) -> float | None:
        """Seconds since the last frame if the source is lost, or silent for longer than a limit; 0 if it is not lost.

        None before the first frame or failure.
        """
        silence = monotonic() - self.last_frame
        if self.problem or silence > limit:
            return silence
        return 0.0 if self._has_frame else None


def _name(text: str) -> str:
    """Return the name of a source for results: the last part of its address, or the host; no user, no password.

    >>> [_name(text) for text in ("0", "/dev/video2", "rtsp://me:sec[ret@10.0.0.7:554/cam/one.sdp?x=1", "http://10.0.0.7")]
    ['video0', 'video2', 'one', '10.0.0.7']
    """
    if text.isdigit():
        return f"video{text}"
    # By hand: urlsplit raises ValueError for a bracket in a password.
    host, _, path = re.sub(r"^\w+://|[?#].*", "", without_password(text)).partition("/")
    word = path.rstrip("/").rpartition("/")[2].partition(".")[0]
    word = word or re.sub(r":\d+$", "", host).strip("[].").lower() or "live"
    return re.sub(r"[^\w.-]", "_", word)
