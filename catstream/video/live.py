"""Live sources: cameras and network streams. They return the newest frame, and reconnect after a loss, without limit.

A thread reads and decodes continuously and stores only the newest frame. A slow consumer therefore gets fewer frames,
never old ones; the skipped frames are counted. If no frame arrives within a timeout, or the stream ends or fails, the
source reconnects with exponential backoff until it succeeds or the consumer closes it. The timeouts apply to frames: a
camera that sends audio but no video also counts as lost. `catstream.video.reconnect` decides how to connect again.

HTTP has three special cases. The address of a still picture is polled. MJPEG that FFmpeg's demuxer for it rejects,
because a part has another content type or none, is read by the demuxer that searches for JPEGs only. HLS delivers
segments of some seconds at once; their frames are returned at the pace of their time stamps.

H.264 over RTSP is decoded without FFmpeg's parser, which would delay it by one frame: see `catstream.video.nal_units`.
"""

from __future__ import annotations

import errno
import logging
import math
import random
import re
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import TYPE_CHECKING, Any

import cv2

from catstream.base.addresses import without_password
from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.frames import RATE, Frame, Source, UprightConverter, ffmpeg_reason, open_video, video_stream
from catstream.video.nal_units import OPTIONS, NalUnits
from catstream.video.reconnect import Attempt, Loss, next_attempt

if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer

_IDLE_SECONDS = 0.1
_POLL_SECONDS = 1.0  # between two requests of a still picture, which cameras update about as often
_QUIET_SECONDS = 600.0  # between two log lines with the same reason
_LONGEST_SEGMENT, _LONGEST_PLAYLIST = 20.0, 60.0  # seconds; of a segment, HLS recommends 6
_SLOW = "check the camera; if it is slow, raise run.open_timeout_seconds or run.read_timeout_seconds"
_ENDED, _INVALID = "end of stream", "no readable video"
_SILENT, _NO_FRAME = f"no data: {_SLOW}", f"data without video frames: {_SLOW}"

# TCP first, because over UDP a lost packet damages the picture; a camera without TCP is still received over UDP.
_OPTIONS = {"rtsp_flags": "prefer_tcp", "analyzeduration": "500000"}
_UNPARSED_OPTIONS = _OPTIONS | OPTIONS
#: For the demuxer that searches for JPEGs: FFmpeg would wait for several of them, and invent time stamps.
_JPEG_OPTIONS = {"probesize": "32", "analyzeduration": "1", "fflags": "nofillin"}

_LATE_SECONDS, _CAUGHT_UP_SECONDS = 2.0, 0.5  # latency at which dropping packets begins, and ends

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
        self._measures_rate = rate is None
        self.skipped = self.reconnects = 0
        protocol, mark, path = text.partition("://")
        self._text = protocol.lower() + mark + path  # FFmpeg's names of protocols are in lower case
        self._address, self._settings = without_password(text), settings
        self._parses = not self._text.startswith("rtsp") or bool(settings.hwaccel)  # by FFmpeg's parser
        self._paced = (-math.inf, 0.0)  # time stamp of the last frame of a segment, and when it was returned
        self._number, self.zero, self._idle = start, since, idle
        self._upright = UprightConverter()
        self._condition = threading.Condition()  # guards the fields below
        self._newest: tuple[float, VideoFrame] | None = None
        self._problem = ""  # why the source is lost; empty while it is connected
        self._log_times: dict[str, float] = {}  # of the last log line with each reason
        self._is_logged = False  # whether this loss was logged
        self._last_frame_time, self._has_frame = monotonic(), False
        self._closed = False
        self._was_open = idle is not None  # without `idle`, a first failure is an error, not a loss
        self._thread = threading.Thread(target=self._read, name=f"reader of {self.name}", daemon=True)
        self._thread.start()
        self._first: Frame | None = None
        if idle is None:
            self._first = self._first_frame()

    @property
    def counters(self) -> dict[str, float]:
        """`skipped`: frames that were replaced by a newer one before they were returned; `reconnects`: successful
        reconnections; `lost_seconds`: seconds since the source was lost, 0 while it is connected. It is absent before
        the first frame or failure: a detector that was restarted does not know it yet."""
        silent = monotonic() - self._last_frame_time
        # FFmpeg has no timeout for a device that hangs, so a long silence also counts as a loss.
        limits = self._settings.open_timeout_seconds, self._settings.read_timeout_seconds, _POLL_SECONDS
        lost = silent if self._problem or silent > sum(limits) else 0.0
        counters: dict[str, float] = {"skipped": self.skipped, "reconnects": self.reconnects}
        return counters | {"lost_seconds": lost} if lost or self._has_frame else counters

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
        # The thread of a device that hangs is not waited for: it ends with its timeout or with the process.
        self._thread.join(1.0)

    def _first_frame(self) -> Frame:
        """Return the first frame. Raises VideoError at the first failure, because the address is probably wrong."""
        while (newest := self._wait_for_newest()) is None:
            if self._problem:
                self.close()
                problem, _, advice = self._problem.partition(": ")
                if re.search("40[13]", problem):
                    cause = "its user and password"
                elif "://" in self._text:
                    cause = "that it is running, and its address"
                else:
                    cause = "that the camera is connected (ls /dev/video*)"
                folder = f"; the folder of that name is ./{self._text}" if self._text.isdigit() else ""
                raise VideoError(f"cannot open {self._address!r} ({problem}): {advice or f'check {cause}{folder}'}")
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
        self.zero = moment if self.zero is None else self.zero
        frame = Frame(self._number, max(0.0, moment - self.zero), image, decoded.time)
        self._number += 1
        return frame

    # --- the thread ------------------------------------------------------------------------------

    def _read(self) -> None:
        """Read frames and keep the newest; reconnect after each loss."""
        attempt, begin = Attempt(), monotonic()
        while not self._closed:
            loss = self._connect(attempt, begin)
            attempt = next_attempt(attempt, loss, is_http=_is_http(self._text))
            if attempt.begin == "at once":  # within the time of the first attempt, unless that was a success
                begin = monotonic() if loss.frames else begin
                continue
            with self._condition:
                if attempt.begin == "poll":
                    wait = begin + _POLL_SECONDS - monotonic()
                else:
                    wait = attempt.backoff * random.uniform(0.5, 1)
                    self._report_loss(loss.reason)
                self._condition.wait_for(lambda: self._closed, wait)
            begin = monotonic()

    def _connect(self, attempt: Attempt, begin: float) -> Loss:
        """Connect once, and store the frames until the connection is lost."""
        import av

        frames = 0
        try:
            for decoded in self._decoded(attempt, begin):
                self._store_newest(monotonic(), decoded)
                frames += 1
        except av.FFmpegError as error:
            silence = monotonic() - max(begin, self._last_frame_time)
            if isinstance(error, av.ExitError) or silence >= self._settings.read_timeout_seconds:
                return Loss("silent", frames, _SILENT)  # FFmpeg's messages for a timeout are unclear
            if isinstance(error, av.InvalidDataError):
                return Loss("invalid", frames, _INVALID)
            # A connection that was closed is an error of input and output if no length was stated.
            if not (frames and (isinstance(error, EOFError) or error.errno == errno.EIO)):
                return Loss("failed", frames, ffmpeg_reason(error))
        except TimeoutError as error:
            return Loss("silent", frames, str(error))
        except Exception as error:  # an unexpected error must not end the thread silently
            return Loss("failed", frames, str(error).replace(self._text, self._address))
        if attempt.demuxer and not frames:  # an HTML page, for example
            return Loss("invalid", frames, _INVALID)
        return Loss("ended", frames, _ENDED)

    def _decoded(self, attempt: Attempt, begin: float) -> Iterator[VideoFrame]:
        """Yield the undamaged frames of one connection, or of two if the first shows that a parser is necessary."""
        import av

        if not self._parses:
            try:
                yield from self._received(attempt, begin, NalUnits())
                return
            except (av.InvalidDataError, TimeoutError, ValueError):
                self._parses = True
        yield from self._received(attempt, begin, None)

    def _received(self, attempt: Attempt, begin: float, units: NalUnits | None) -> Iterator[VideoFrame]:
        """Yield the undamaged frames of one connection, until it ends. Without `units`, FFmpeg parses the stream.

        While it is unknown whether FFmpeg's probing succeeds, a part of the time is reserved for the other demuxer, or
        for the parser. ValueError if H.264 cannot be decoded without the parser, or it is not H.264. TimeoutError, with
        the reason, if data arrives without frames, or a packet was cut off because nothing arrives.
        """
        from av.codec.context import Flags2

        settings, due = self._settings, begin + self._settings.open_timeout_seconds
        if _is_http(self._text) and not attempt.demuxer and not attempt.proven:
            due -= settings.open_timeout_seconds / 5
        elif units is not None and not attempt.proven:
            due -= settings.open_timeout_seconds / 2
        read_timeout = settings.read_timeout_seconds + (".m3u8" in self._text) * _LONGEST_SEGMENT
        timeouts = max(1.0, due - monotonic()), read_timeout
        options = _JPEG_OPTIONS if attempt.demuxer else _OPTIONS if units is None else _UNPARSED_OPTIONS
        options = options if self._measures_rate else options | {"fpsprobesize": "0"}
        with _open_container(self._text, attempt.demuxer, options, timeouts, settings.hwaccel) as container:
            stream, is_segmented = video_stream(container), container.format.name == "hls"
            stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
            if units is not None:
                if stream.codec_context.name != "h264":
                    raise ValueError(f"{stream.codec_context.name} needs the parser")
                stream.codec_context.flags2 |= Flags2.chunks
            if self._measures_rate and units is None:  # without the parser, FFmpeg states the clock of RTP, 90 kHz
                self.rate = float(stream.average_rate or stream.guessed_rate or RATE)
            now, backlog = monotonic(), Backlog()
            for packet in container.demux():
                before, now = now, monotonic()
                if self._closed:
                    return
                if now > due:
                    raise TimeoutError(_SILENT if now - before > 0.9 * settings.read_timeout_seconds else _NO_FRAME)
                if packet.stream_index != stream.index:  # audio, which may continue without the video
                    continue
                for unit in [packet] if units is None else units.take(packet):
                    sent = None if unit.pts is None or is_segmented else float(unit.pts * unit.time_base)
                    if backlog.drops(now, sent, is_key=unit.is_keyframe):
                        self.skipped += 1
                        due = now + settings.read_timeout_seconds
                        continue
                    for frame in _undamaged(stream, unit):
                        if not is_segmented or self._is_next(frame):
                            yield frame
                        due = monotonic() + settings.read_timeout_seconds + is_segmented * _LONGEST_SEGMENT
                    backlog.is_decoded(monotonic())

    def _is_next(self, frame: VideoFrame) -> bool:
        """Wait until a frame of a segment is due. Returns False for a frame that was returned with the same segment."""
        (time, moment), now = self._paced, monotonic()
        ahead = (frame.time or 0.0) - time
        if -_LONGEST_PLAYLIST < ahead <= 0:
            return False
        # The time stamps of the next segment may begin again.
        moment = max(now, moment + ahead) if 0 < ahead < _LONGEST_SEGMENT else now
        self._paced = frame.time or 0.0, moment
        with self._condition:
            self._condition.wait_for(lambda: self._closed, moment - now)
        return True

    def _store_newest(self, moment: float, decoded: VideoFrame) -> None:
        with self._condition:
            if self._closed:
                return
            if self._problem:
                self.reconnects += 1
                if self._is_logged:
                    _log.warning("reconnected to source %s after %.1f s", self.name, moment - self._last_frame_time)
            self.skipped += self._newest is not None
            self._newest, self._last_frame_time, self._problem = (moment, decoded), moment, ""
            self._has_frame, self._was_open, self._is_logged = True, True, False
            self._condition.notify()

    def _report_loss(self, problem: str) -> None:
        """Log a loss, but a reason at most once in ten minutes: a source may be lost for days, or again and again."""
        now = monotonic()
        if self._was_open and not self._closed and now - self._log_times.get(problem, -math.inf) > _QUIET_SECONDS:
            _log.warning("lost source %s (%s); reconnecting", self.name, problem)
            self._log_times[problem] = now
            self._is_logged = True
        self._problem = problem


class Backlog:
    """Decides which packets of a stream to drop because they arrive faster than they are decoded.

    The latency would grow without limit. From two seconds on, only keyframes are decoded until it is small again,
    because no other frame refers to what was dropped. The latency is not measured by the camera's clock, which may
    drift: a stream whose decoder mostly waits for packets is on time.
    """

    def __init__(self) -> None:
        self._is_late = False
        self._min_age = math.inf  # arrival less time stamp of a packet on time
        self._decoded: float | None = None  # when the last packet was decoded
        self._key = 0.0  # arrival of the last keyframe
        self._waited = 0.0  # seconds without a packet since then

    def drops(self, now: float, time: float | None, *, is_key: bool) -> bool:
        """Return whether to drop a packet that arrives now, with this time stamp."""
        if time is None:
            return False
        wait = now - (now if self._decoded is None else self._decoded)
        age = now - time
        self._decoded = now
        self._waited += wait
        self._min_age = min(self._min_age, age)
        if wait > _LATE_SECONDS / 2:  # the network stalled, and the delayed packets arrive now
            self._min_age = age
        if is_key:
            if self._waited > (now - self._key) / 2:
                self._min_age = age
            self._is_late = self._is_late and age - self._min_age > _CAUGHT_UP_SECONDS
            self._key = now
            self._waited = 0.0
        self._is_late = self._is_late or age - self._min_age > _LATE_SECONDS
        return self._is_late and not is_key

    def is_decoded(self, now: float) -> None:
        """Record when the last packet was decoded."""
        self._decoded = now


def _undamaged(stream: Any, packet: Packet[Any]) -> list[VideoFrame]:
    """Decode a packet. Damaged frames, and the frames of a damaged packet, are left out."""
    import av

    try:
        return [frame for frame in stream.codec_context.decode(packet) if not frame.is_corrupt]
    except av.FFmpegError:
        return []


def _is_http(text: str) -> bool:
    return text.startswith(("http:", "https:"))


def _open_container(
    text: str, demuxer: str | None, options: dict[str, str], timeouts: tuple[float, float], hwaccel: str
) -> InputContainer:
    """Open a camera or a stream. Raises PyAV's errors, and VideoError if it has no live video."""
    is_address = "://" in text
    container = open_video(
        f"/dev/video{text}" if text.isdigit() else text,
        hwaccel,
        format=demuxer if is_address else "v4l2",
        options=options,
        timeout=timeouts,
    )
    problem = ""
    kind = container.format.name
    has_end = container.duration if kind in ("hls", "dash") else (container.size or 0) > 0
    if video_stream(container) is None:
        problem = "no video stream"
    elif _is_http(text) and has_end and not kind.endswith(("_pipe", "image2", "mjpeg", "mpjpeg")):
        problem = "a recording: download it, and pass the file"
    if problem:
        container.close()
        raise VideoError(problem)
    return container


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
