"""Live sources: cameras and network streams. They give the newest frame, and reconnect after a loss, without limit.

A thread reads and decodes continuously and keeps only the newest frame. A slow consumer therefore gets fewer frames,
never old ones; the skipped frames are counted. If no frame arrives within a time-out, or the stream ends or fails, the
source is closed and reopened with exponential backoff until it is back or the consumer closes it. The time-outs count
frames: a camera whose sound goes on without its picture is lost, too.

HTTP has three special cases. The address of a still picture is fetched again and again. MJPEG that FFmpeg's demuxer for
it rejects, because a part has another type or none, is read by the one that looks for JPEGs only. HLS sends segments of
some seconds at once; their frames are returned at the pace of their time stamps.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import random
import re
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import TYPE_CHECKING

import cv2

from catstream.base.addresses import without_password
from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason, open_video, video_stream

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

_FIRST_PAUSE, _LONGEST_PAUSE = 0.25, 8.0
_IDLE_SECONDS = 0.1
_QUIET_SECONDS = 600.0  # the same reason of a loss is not logged again before
_LONGEST_SEGMENT, _LONGEST_PLAYLIST = 20.0, 60.0  # seconds; of a segment, HLS recommends 6
_SLOW = "check the camera; if it is slow, raise run.open_seconds or run.silent_seconds"
_ENDED, _SILENT, _NO_FRAME = "it ended", f"nothing arrives: {_SLOW}", f"data arrives, but no picture: {_SLOW}"

# TCP first, because over UDP a lost packet damages the picture; a camera without TCP is still received over UDP.
_OPTIONS = {"rtsp_flags": "prefer_tcp", "analyzeduration": "500000"}
#: To look for JPEGs: FFmpeg would wait for several of them, and invent time stamps.
_JPEG_OPTIONS = {"probesize": "32", "analyzeduration": "1", "fflags": "nofillin"}

_LATE_SECONDS, _CAUGHT_UP_SECONDS = 2.0, 0.5  # of a picture, from which frames are left out, and are not any more

_log = logging.getLogger(__name__)


class LiveSource(Source):
    """A camera or a stream; each iteration gives its newest frame. `catstream.video.source.open_source` opens one.

    Iteration waits for a frame that was not returned yet. If the source reconnects with another image size, its frames
    are scaled to the size of the first one. VideoError from the constructor, if the source cannot be opened and no
    `idle` was given; never later.
    """

    live = True

    def __init__(
        self, text: str, start: int, settings: RunSettings, *, since: float | None, idle: Callable[[], bool] | None
    ) -> None:
        super().__init__(_name(text), RATE, (0, 0))
        self.skipped = self.reopened = 0
        protocol, mark, place = text.partition("://")
        self._text = protocol.lower() + mark + place  # FFmpeg knows its protocols in small letters
        self._address, self._settings = without_password(text), settings
        self._format: str | None = None  # for the next connection; None if FFmpeg finds it out
        self._shown = (-math.inf, 0.0)  # time stamp of the last frame of a segment, and when it was returned
        self._number, self._zero, self._idle = start, since, idle
        self._upright = UprightConverter()
        self._condition = threading.Condition()  # guards the fields below
        self._newest: tuple[float, VideoFrame] | None = None
        self._problem = ""  # why the source is lost; empty while it is not
        self._logged: dict[str, float] = {}  # when each reason of a loss was logged
        self._is_logged = False  # whether a reason of this loss was
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
        limits = self._settings.open_seconds, self._settings.silent_seconds, self._settings.poll_seconds
        lost = silent if self._problem or silent > sum(limits) else 0.0
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
                what = (
                    "its user and password" if re.search("40[13]", problem) else "that it is running, and its address"
                )
                advice = advice or f"check {what}{hint}"
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

        pause, opened = _FIRST_PAUSE, 0.0
        is_known = False  # whether frames came by this way of reading
        while not self._closed:
            opened, count, problem, is_other, is_invalid = opened or monotonic(), 0, _ENDED, False, False
            try:
                for decoded in self._decoded(opened, is_known):
                    self._store_newest(monotonic(), decoded)
                    pause, count, is_known = _FIRST_PAUSE, count + 1, True
            except av.FFmpegError as error:
                is_invalid = isinstance(error, av.InvalidDataError)
                # A connection that was closed is an error of input and output if no length was stated.
                is_end = count and (isinstance(error, EOFError) or error.errno == errno.EIO)
                problem = _ENDED if is_end else ffmpeg_reason(error)
                if monotonic() - max(opened, self._last_frame_time) >= self._settings.silent_seconds:
                    is_invalid, problem = False, _SILENT  # FFmpeg's messages for a time-out are unclear
                is_other, is_known = is_invalid or (problem == _SILENT and not is_known), is_known and not is_invalid
            except TimeoutError as error:
                problem, is_other = str(error), not is_known
            except Exception as error:  # an unexpected error must not end the thread silently
                problem = str(error).replace(self._text, self._address)
            if is_other and self._format is None and _is_http(self._text):
                self._format, opened = "mjpeg", 0.0 if count else opened
                continue
            if is_invalid or (self._format and not count and problem == _ENDED):  # a page, for example
                problem = "it sends no video that can be read"
            self._format = self._format if is_known else None
            with self._condition:
                if problem == _ENDED and count == 1 and _is_http(self._text):  # a still picture
                    wait = opened + self._settings.poll_seconds - monotonic()
                else:
                    self._report_loss(problem)
                    wait, pause = pause * random.uniform(0.5, 1), min(2 * pause, _LONGEST_PAUSE)
                self._condition.wait_for(lambda: self._closed, wait)
            opened = 0.0

    def _decoded(self, opened: float, is_known: bool) -> Iterator[VideoFrame]:
        """Yield the undamaged frames of one connection, until it ends.

        If no frame came before, a part of the time is left for the other way of reading MJPEG. TimeoutError, with the
        reason, if data arrives without frames, or a packet was cut off because nothing arrives.
        """
        import av

        settings, due = self._settings, opened + self._settings.open_seconds
        if _is_http(self._text) and self._format is None and not is_known:
            due -= settings.open_seconds / 5
        timeouts = max(1.0, due - monotonic()), settings.silent_seconds + (".m3u8" in self._text) * _LONGEST_SEGMENT
        with _open_container(self._text, self._format, timeouts, settings.hardware) as container:
            stream, is_segmented = video_stream(container), container.format.name == "hls"
            stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
            self.rate = float(stream.average_rate or stream.guessed_rate or RATE)
            now, backlog = monotonic(), Backlog()
            for packet in container.demux():
                before, now = now, monotonic()
                if self._closed:
                    return
                if now > due:
                    raise TimeoutError(_SILENT if now - before > 0.9 * settings.silent_seconds else _NO_FRAME)
                if packet.stream_index != stream.index:  # sound may go on while the picture does not
                    continue
                sent = None if packet.pts is None or is_segmented else float(packet.pts * packet.time_base)
                if backlog.arrives(now, sent, is_key=packet.is_keyframe):
                    self.skipped += 1
                    due = now + settings.silent_seconds
                    continue
                decoded: list[VideoFrame] = []
                with contextlib.suppress(av.FFmpegError):  # the packet is damaged; the next may be whole
                    decoded = stream.codec_context.decode(packet)
                for frame in decoded:
                    if not frame.is_corrupt:
                        if not is_segmented or self._is_next(frame):
                            yield frame
                        due = monotonic() + settings.silent_seconds + is_segmented * _LONGEST_SEGMENT
                backlog.is_done(monotonic())

    def _is_next(self, frame: VideoFrame) -> bool:
        """Wait until a frame of a segment is due; returns False if a segment was fetched again, and it was shown."""
        (time, moment), now = self._shown, monotonic()
        ahead = (frame.time or 0.0) - time
        if -_LONGEST_PLAYLIST < ahead <= 0:
            return False
        # The time stamps of the next segment may begin again.
        moment = max(now, moment + ahead) if 0 < ahead < _LONGEST_SEGMENT else now
        self._shown = frame.time or 0.0, moment
        with self._condition:
            self._condition.wait_for(lambda: self._closed, moment - now)
        return True

    def _store_newest(self, moment: float, decoded: VideoFrame) -> None:
        with self._condition:
            if self._closed:
                return
            if self._problem:
                self.reopened += 1
                if self._is_logged:
                    _log.warning("the source %s is back after %.1f s", self.name, moment - self._last_frame_time)
            self.skipped += self._newest is not None
            self._newest, self._last_frame_time, self._problem, self._was_open = (moment, decoded), moment, "", True
            self._is_logged = False
            self._condition.notify()

    def _report_loss(self, problem: str) -> None:
        """Log the reason of a loss, once for each reason: a source may be lost for days, or again and again."""
        now = monotonic()
        if self._was_open and not self._closed and now - self._logged.get(problem, -math.inf) > _QUIET_SECONDS:
            _log.warning("the source %s is lost (%s); it is reopened until it is back", self.name, problem)
            self._logged[problem], self._is_logged = now, True
        self._problem = problem


class Backlog:
    """Which packets of a stream are left out, because they arrive faster than they are decoded.

    The picture would be ever older. If it is late by some seconds, only key frames are decoded until it is not: nothing
    refers to what is left out. It is not late if decoding mostly waits for packets, whatever the clock of the camera
    says.
    """

    def __init__(self) -> None:
        self._is_late = False
        self._least = math.inf  # age of a packet that did not wait: its arrival less its time stamp
        self._done: float | None = None  # when the packet before was decoded
        self._key, self._waited = 0.0, 0.0  # arrival of the last key frame, and seconds without a packet since then

    def arrives(self, now: float, time: float | None, *, is_key: bool) -> bool:
        """Return whether a packet with this time stamp, which arrives now, is left out."""
        if time is None:
            return False
        wait, self._done, age = now - (now if self._done is None else self._done), now, now - time
        self._waited += wait
        self._least = min(self._least, age)
        if wait > _LATE_SECONDS / 2:  # the network stood still, and what it held back arrives now
            self._least = age
        if is_key:
            if self._waited > (now - self._key) / 2:
                self._least = age
            self._is_late = self._is_late and age - self._least > _CAUGHT_UP_SECONDS
            self._key, self._waited = now, 0.0
        self._is_late = self._is_late or age - self._least > _LATE_SECONDS
        return self._is_late and not is_key

    def is_done(self, now: float) -> None:
        self._done = now


def _is_http(text: str) -> bool:
    return text.startswith(("http:", "https:"))


def _open_container(text: str, form: str | None, timeouts: tuple[float, float], hardware: str) -> InputContainer:
    """Open a camera or a stream. Raises PyAV's errors, and VideoError if it has no live video."""
    is_address = "://" in text
    container = open_video(
        f"/dev/video{text}" if text.isdigit() else text,
        hardware,
        format=form if is_address else "v4l2",
        options=_JPEG_OPTIONS if form else _OPTIONS,
        timeout=timeouts,
    )
    problem, kind = "", container.format.name
    has_end = container.duration if kind in ("hls", "dash") else (container.size or 0) > 0
    if video_stream(container) is None:
        problem = "it has no video"
    elif _is_http(text) and has_end and not kind.endswith(("_pipe", "image2", "mjpeg", "mpjpeg")):
        problem = "it is a recording: download it, and give the file"
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
    word = word or re.sub(r":\d+$", "", host).strip("[].").lower() or "live"
    return re.sub(r"[^\w.-]", "_", word)
