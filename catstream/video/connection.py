"""One connection to a camera or a stream: opened, read and decoded until it ends, fails or times out.

FFmpeg's parser splits a stream into frames, with two exceptions. H.264 over RTSP is split by `NalUnits`, because the
parser would delay it by one frame. MJPEG that FFmpeg's demuxer for it rejects, because a part has another content type
or none, is read by the demuxer that searches for JPEGs only.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Iterator
from time import monotonic
from typing import TYPE_CHECKING, Any

from catstream.base.settings import RunSettings
from catstream.errors import VideoError
from catstream.video.frames import RATE, ffmpeg_reason, open_video, video_stream
from catstream.video.nal_units import OPTIONS, NalUnits
from catstream.video.reconnect import Attempt, Loss, Mode

if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer

LONGEST_SEGMENT = 20.0  #: seconds; HLS recommends 6
_SLOW = "check the camera; if it is slow, raise run.open_timeout_seconds or run.read_timeout_seconds"
ENDED, INVALID = "end of stream", "no readable video"  #: reasons of a loss
_SILENT, _NO_FRAME = f"no data: {_SLOW}", f"data without video frames: {_SLOW}"

# TCP first, because over UDP a lost packet damages the picture; a camera without TCP is still received over UDP.
_PARSED = {"rtsp_flags": "prefer_tcp", "analyzeduration": "500000"}
# JPEGs: FFmpeg would wait for several of them, and invent time stamps.
_JPEGS = {"probesize": "32", "analyzeduration": "1", "fflags": "nofillin"}
_OPTIONS: dict[Mode, dict[str, str]] = {"rtp": _PARSED | OPTIONS, "parsed": _PARSED, "jpegs": _JPEGS}

_LATE_SECONDS, _CAUGHT_UP_SECONDS = 2.0, 0.5  # latency at which dropping packets begins, and ends


class Connection:
    """A connection to a camera or a stream, which `frames` opens.

    begin  moment from which `run.open_timeout_seconds` counts
    rate   frames per second; None if FFmpeg is to measure it, which takes half a second and not in mode "rtp"
    """

    def __init__(self, text: str, settings: RunSettings, attempt: Attempt, begin: float, rate: float | None) -> None:
        self.rate = rate
        self.is_segmented = False  #: whether segments of some seconds arrive at once (HLS)
        self._text = text
        self._hwaccel = settings.hwaccel
        self._mode = attempt.mode
        # While it is unknown whether the first mode can read the stream, a part of the time is reserved for the other.
        is_final = attempt.proven or attempt.mode == modes_of(text, settings)[-1]
        share = 1.0 if is_final else 0.5 if attempt.mode == "rtp" else 0.8
        read_timeout = settings.read_timeout_seconds + (".m3u8" in text) * LONGEST_SEGMENT
        self._deadline = Deadline(begin + share * settings.open_timeout_seconds, read_timeout)

    def frames(self) -> Iterator[VideoFrame | None]:
        """Yield the undamaged frames until the connection ends; None for each packet that `Backlog` drops.

        Raises PyAV's errors, and VideoError if there is no live video. TimeoutError, with the reason, if data arrives
        without frames, or a packet was cut off because nothing arrives. In mode "rtp", ValueError if this is not H.264,
        or it cannot be decoded without the parser.
        """
        with self._open() as container:
            stream, backlog = self._stream(container), Backlog()
            units = NalUnits().take if self._mode == "rtp" else lambda packet: [packet]
            for packet in container.demux():
                self._deadline.check()
                if packet.stream_index != stream.index:  # audio, which may continue without the video
                    continue
                for unit in units(packet):
                    sent = None if unit.pts is None or self.is_segmented else float(unit.pts * unit.time_base)
                    is_late = backlog.drops(monotonic(), sent, is_key=unit.is_keyframe)
                    for frame in [None] if is_late else _undamaged(stream, unit):
                        yield frame
                        self._deadline.extend()
                    backlog.is_decoded(monotonic())

    def _open(self) -> InputContainer:
        is_address = "://" in self._text
        return open_video(
            f"/dev/video{self._text}" if self._text.isdigit() else self._text,
            self._hwaccel,
            format="v4l2" if not is_address else "mjpeg" if self._mode == "jpegs" else None,
            options=_OPTIONS[self._mode] | ({} if self.rate is None else {"fpsprobesize": "0"}),
            timeout=self._deadline.timeouts,
        )

    def _stream(self, container: InputContainer) -> Any:
        """Return the video stream, with its decoder set up."""
        from av.codec.context import Flags2

        stream, kind = video_stream(container), container.format.name
        if stream is None:
            raise VideoError("no video stream")
        has_end = container.duration if kind in ("hls", "dash") else (container.size or 0) > 0
        if is_http(self._text) and has_end and not kind.endswith(("_pipe", "image2", "mjpeg", "mpjpeg")):
            raise VideoError("a recording: download it, and pass the file")
        self.is_segmented = kind == "hls"
        stream.thread_type = "NONE"  # the processes of the pipeline already use the cores
        if self._mode != "rtp":
            self.rate = self.rate or float(stream.average_rate or stream.guessed_rate or RATE)
        elif stream.codec_context.name != "h264":
            raise ValueError(f"{stream.codec_context.name} needs the parser")
        else:
            stream.codec_context.flags2 |= Flags2.chunks
        return stream


def modes_of(text: str, settings: RunSettings) -> tuple[Mode, ...]:
    """Return the modes in which an address can be read, in the order in which they are tried."""
    if text.startswith("rtsp") and not settings.hwaccel:
        return "rtp", "parsed"
    return ("parsed", "jpegs") if is_http(text) else ("parsed",)


def loss_of(error: Exception, frames: int, silence: float, read_timeout: float) -> Loss:
    """Return the loss of a connection that ended with an error after some frames and seconds of silence."""
    import av

    if isinstance(error, av.FFmpegError):
        if isinstance(error, av.ExitError) or silence >= read_timeout:  # FFmpeg's messages for a timeout are unclear
            return Loss("silent", frames, _SILENT)
        # A connection that was closed is an error of input and output if no length was stated.
        if frames and (isinstance(error, EOFError) or error.errno == errno.EIO):
            return Loss("ended", frames, ENDED)
    if isinstance(error, ValueError):  # of FFmpeg or `NalUnits`
        return Loss("invalid", frames, INVALID)
    if isinstance(error, TimeoutError) and not isinstance(error, av.FFmpegError):  # of `Deadline`
        return Loss("silent", frames, str(error))
    return Loss("failed", frames, ffmpeg_reason(error) if isinstance(error, av.FFmpegError) else str(error))


class Deadline:
    """The moment at which a connection counts as lost, unless a frame extends it by `seconds` before."""

    def __init__(self, moment: float, seconds: float) -> None:
        self._moment = moment
        self._seconds = seconds
        self._packet = monotonic()  # arrival of the last packet

    @property
    def timeouts(self) -> tuple[float, float]:
        """Seconds in which FFmpeg has to open the connection, and to read each packet."""
        return max(1.0, self._moment - monotonic()), self._seconds

    def check(self) -> None:
        """Raise TimeoutError, with the reason, if a packet arrives after the deadline."""
        before, self._packet = self._packet, monotonic()
        if self._packet > self._moment:
            raise TimeoutError(_SILENT if self._packet - before > 0.9 * self._seconds else _NO_FRAME)

    def extend(self) -> None:
        self._moment = monotonic() + self._seconds


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


def is_http(text: str) -> bool:
    """Return whether an address is one of HTTP or HTTPS."""
    return text.startswith(("http:", "https:"))
