"""The camera of a load test: a process that sends known images over HTTP or RTSP at the times of a schedule.

Each frame is sent when it is due, even if the receiver has not read the frames before it; a slow receiver gets frames
late, but none is dropped. The time stamp of a frame in the stream is its due time by `time.monotonic`, so the receiver
can compute its number and its age. Over HTTP, the container is NUT, because FFmpeg returns its frames without delay;
for other containers, and for H.264 over RTSP, it buffers one frame.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from itertools import cycle
from multiprocessing.connection import Connection
from time import monotonic
from typing import Any, Self, cast

from catstream.base.workers import SPAWN, die_with, sigint_blocked
from catstream.errors import ServiceError
from catstream.loadtest.rtsp import RtspConnection

_TICKS_PER_SECOND = 1_000_000  # time base of the stream
_STILL_RATE = 25.0  # frames per second of the still image before a schedule is played


@dataclass(frozen=True, slots=True)
class Schedule:
    """The due time of each frame. Before the first and after the last frame, a still image is sent.

    start   due time of frame 0, by `time.monotonic`
    rate    frames per second
    frames  number of frames

    >>> clip = Schedule(start=100.0, rate=25.0, frames=50)
    >>> clip.due(5), clip.number(100.2), clip.following(100.21)
    (100.2, 5, 6)
    """

    start: float
    rate: float
    frames: int

    def due(self, number: int) -> float:
        return self.start + number / self.rate

    def number(self, moment: float) -> int:
        """Return the frame whose due time is nearest to a moment."""
        return round((moment - self.start) * self.rate)

    def following(self, moment: float) -> int:
        """Return the first frame that is due at a moment or after it."""
        return math.ceil((moment - self.start) * self.rate)

    def picture(self, number: int, pictures: int) -> int:
        """Return the index of the image that a frame shows, out of `pictures`: forwards, then backwards, and so on.

        >>> [Schedule(0.0, 25.0, 7).picture(number, 3) for number in range(-2, 9)]
        [0, 0, 0, 1, 2, 1, 0, 1, 2, 2, 2]
        """
        number, last = min(max(number, 0), self.frames - 1), pictures - 1
        return last - abs(number % max(2 * last, 1) - last)


class Camera:
    """A process with a `Broadcast`, so that frames are sent on time regardless of other work; a context manager.

    urls : URL of each stream
    """

    def __init__(
        self,
        files: Sequence[bytes],
        size: tuple[int, int],
        streams: int,
        source: str = "mjpeg",
        still: Sequence[bytes] = (),
    ) -> None:
        self._pipe, self._other = SPAWN.Pipe()
        arguments = self._other, os.getpid(), files, size, streams, source, still
        self._process = SPAWN.Process(target=_broadcast, args=arguments, daemon=True)

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def late(self) -> float:
        """Largest delay in seconds of a frame of this schedule that was not caused by a slow receiver."""
        seconds: float = self._ask(None)
        return seconds

    def show_still(self) -> None:
        """Send the first image repeatedly."""
        self.play(Schedule(monotonic(), _STILL_RATE, frames=1))

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Send the images by a schedule; return the schedule of each stream."""
        schedules: list[Schedule] = self._ask(schedule)
        return schedules

    def __enter__(self) -> Self:
        with sigint_blocked():
            self._process.start()
        self._other.close()
        self.urls = self._receive()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _ask(self, question: Schedule | None) -> Any:
        self._pipe.send(question)
        return self._receive()

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            raise ServiceError("the camera of the load test has exited: its error is printed above") from None


def _broadcast(pipe: Connection, parent: int, *images: Any) -> None:
    die_with(parent)
    with Broadcast(*images) as broadcast:
        pipe.send(broadcast.urls)
        while True:
            question = pipe.recv()
            pipe.send(broadcast.late if question is None else broadcast.play(question))


class Broadcast(ThreadingHTTPServer):
    """Serves streams of the same images on the loopback interface; a context manager.

    `files` are JPEG files for the source mjpeg, and access units of `rtsp.encode` for h264. `still` is the first image,
    sent over and over: a keyframe takes several times as long to decode as the frames after it that show no change.

    The schedules of n streams are shifted by 1/n of a frame each, so that frames are not due at the same time.

    urls : URL of each stream
    late : largest delay in seconds of a sent frame that was not caused by a slow receiver
    """

    daemon_threads = True

    def __init__(
        self,
        files: Sequence[bytes],
        size: tuple[int, int],
        streams: int = 1,
        source: str = "mjpeg",
        still: Sequence[bytes] = (),
    ) -> None:
        self._is_h264 = source == "h264"
        super().__init__(("127.0.0.1", 0), RtspConnection if self._is_h264 else _Connection)
        self._files, self._still, self._size, self._closed = files, still or files[:1], size, threading.Event()
        self._schedules = [Schedule(monotonic(), _STILL_RATE, frames=1)] * streams
        self.late = 0.0
        protocol = "rtsp" if self._is_h264 else "http"
        self.urls = [f"{protocol}://127.0.0.1:{self.server_port}/{number}" for number in range(streams)]

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Start to send the images by a schedule; return the schedule of each stream."""
        step = 1 / (schedule.rate * len(self.urls))
        self._schedules = [replace(schedule, start=schedule.start + number * step) for number in range(len(self.urls))]
        self.late = 0.0
        return self._schedules

    def __enter__(self) -> Self:
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self.shutdown()
        self.server_close()

    def send(self, stream: int, file: BufferedIOBase) -> None:
        """Send a stream to one receiver until it disconnects."""
        import av

        clock, pipe = Fraction(1, _TICKS_PER_SECOND), _WriteOnlyFile(file)
        with av.open(pipe, "w", format="nut", options={"flush_packets": "1"}) as container:
            track: Any = container.add_stream("mjpeg", rate=Fraction(_STILL_RATE))
            track.width, track.height, track.pix_fmt, track.time_base = *self._size, "yuvj420p", clock
            for moment, picture in self.frames(stream):
                packet = av.Packet(picture)
                packet.stream, packet.time_base, packet.is_keyframe = track, clock, True
                packet.pts = packet.dts = round(moment * _TICKS_PER_SECOND)
                container.mux(packet)
                if pipe.broken:
                    break

    def frames(self, stream: int) -> Iterator[tuple[float, bytes]]:
        """Yield due time and file of each frame when it is due; switch to a new schedule as soon as it is set."""
        while not self._closed.is_set():
            schedule = self._schedules[stream]
            number, still = schedule.following(monotonic()), cycle(self._still)
            while schedule is self._schedules[stream]:
                due = schedule.due(number)
                if (seconds := due - monotonic()) > 0:
                    if self._closed.wait(min(seconds, 1 / _STILL_RATE)):
                        return
                    if seconds > 1 / _STILL_RATE:
                        continue
                    self.late = max(self.late, monotonic() - due)
                yield due, next(still) if number < 0 or schedule.frames == 1 else self._file(schedule, number)
                number += 1

    def _file(self, schedule: Schedule, number: int) -> bytes:
        if not self._is_h264:
            return self._files[schedule.picture(number, len(self._files))]
        return self._files[number % len(self._files)]  # most refer to the one before: the video goes on after its end


class _Connection(BaseHTTPRequestHandler):
    disable_nagle_algorithm = True  # otherwise the end of a frame waits 40 ms for a delayed acknowledgement

    def do_GET(self) -> None:
        broadcast, name = cast(Broadcast, self.server), self.path.strip("/")
        if not name.isdigit() or int(name) >= len(broadcast.urls):
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "video/x-nut")
        self.end_headers()
        broadcast.send(int(name), self.wfile)

    def log_message(self, *_: object) -> None:
        pass


class _WriteOnlyFile:
    """A write-only file for PyAV. Errors are recorded: one raised inside PyAV is raised again when it ends the file.

    broken  whether the receiver has disconnected
    """

    def __init__(self, file: BufferedIOBase) -> None:
        self._file, self.broken = file, False

    def write(self, data: bytes) -> int:
        if not self.broken:
            try:
                self._file.write(data)
            except OSError:
                self.broken = True
        return len(data)
