"""A stream whose every frame is known: pictures that leave over HTTP at the moments of a schedule.

    with Broadcast(pictures, (640, 480)) as camera:
        source = open_source(camera.urls[0])
        camera.play(Schedule(start=monotonic() + 1, rate=25.0, frames=250))

To put under load what follows a stream. Each frame is sent when it is due, whether or not those before it were
taken: a slow reader finds frames late, none is left out. The time stamp of a frame in the stream is the moment at
which it was due, by `time.monotonic`: so its number and its age are known wherever it arrives. The container is
NUT: FFmpeg gives its frames at once, and holds one back of others.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from time import monotonic
from typing import Any, Self

import cv2
import numpy as np

__all__ = ["Broadcast", "Schedule", "jpeg"]

_JPEG_QUALITY = 90  # of JPEG: what cameras send
_TICKS_PER_SECOND = 1_000_000  # of the stream's clock in a second
_STILL_RATE = 25.0  # frames a second before anything is played


@dataclass(frozen=True, slots=True)
class Schedule:
    """When each frame is due. Before the first and after the last one the picture stands still.

    start   moment of `time.monotonic` at which frame 0 is due
    rate    frames a second
    frames  how many there are

    >>> clip = Schedule(start=100.0, rate=25.0, frames=50)
    >>> clip.due(5), clip.number(100.2), clip.following(100.21)
    (100.2, 5, 6)
    """

    start: float
    rate: float
    frames: int

    def due(self, number: int) -> float:
        """The moment of a frame."""
        return self.start + number / self.rate

    def number(self, moment: float) -> int:
        """The frame that is due at a moment, or nearest to it."""
        return round((moment - self.start) * self.rate)

    def following(self, moment: float) -> int:
        """The first frame that is due at a moment or after it."""
        return math.ceil((moment - self.start) * self.rate)

    def picture(self, number: int, pictures: int) -> int:
        """Which of so many pictures a frame shows: forwards, backwards, and so on, without a jump.

        >>> [Schedule(0.0, 25.0, 7).picture(number, 3) for number in range(-2, 9)]
        [0, 0, 0, 1, 2, 1, 0, 1, 2, 2, 2]
        """
        shown, last = min(max(number, 0), self.frames - 1), pictures - 1
        return last - abs(shown % max(2 * last, 1) - last)


def jpeg(image: np.ndarray) -> bytes:
    """An image as a camera sends it."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


class Broadcast:
    """Serves streams of the same pictures on loopback; a context manager.

    Several streams are not in step: the frames of each are due a part of a frame after those of the one before.

    Parameters
    ----------
    pictures : JPEG files
    size : (width, height) of all of them, in pixels
    streams : how many there are

    Attributes
    ----------
    urls : of each stream
    late : seconds by which it sent a frame too late at most, and that was not a reader's fault
    """

    def __init__(self, pictures: Sequence[bytes], size: tuple[int, int], streams: int = 1) -> None:
        self._pictures, self._size, self._closed = pictures, size, threading.Event()
        self._schedules = [Schedule(monotonic(), _STILL_RATE, frames=1)] * streams
        self.late = 0.0
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_ConnectionHandler, self))
        self._server.daemon_threads = True
        self.urls = [f"http://127.0.0.1:{self._server.server_port}/{number}" for number in range(streams)]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Show the pictures from now on as a schedule says; returns that of each stream."""
        step = 1 / (schedule.rate * len(self._schedules))
        self._schedules = [
            replace(schedule, start=schedule.start + number * step) for number in range(len(self._schedules))
        ]
        self.late = 0.0
        return self._schedules

    def send(self, stream: int, file: BufferedIOBase) -> None:
        """Send a stream to a reader until it is gone."""
        import av

        clock, pipe = Fraction(1, _TICKS_PER_SECOND), _WriteOnlyFile(file)
        with av.open(pipe, "w", format="nut", options={"flush_packets": "1"}) as container:
            track: Any = container.add_stream("mjpeg", rate=Fraction(_STILL_RATE))
            track.width, track.height, track.pix_fmt, track.time_base = *self._size, "yuvj420p", clock
            for moment, picture in self._frames(stream):
                packet = av.Packet(self._pictures[picture])
                packet.stream, packet.time_base, packet.is_keyframe = track, clock, True
                packet.pts = packet.dts = round(moment * _TICKS_PER_SECOND)
                container.mux(packet)
                if pipe.broken:
                    break

    def close(self) -> None:
        """Close all connections, and take no more."""
        self._closed.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _frames(self, stream: int) -> Iterator[tuple[float, int]]:
        """Moment and picture of each frame from now on, when it is due; of a new schedule once there is one."""
        while not self._closed.is_set():
            schedule = self._schedules[stream]
            number = schedule.following(monotonic())
            while schedule is self._schedules[stream]:
                due = schedule.due(number)
                if (left := due - monotonic()) > 0:
                    if self._closed.wait(min(left, 1 / _STILL_RATE)):
                        return
                    if left > 1 / _STILL_RATE:
                        continue
                    self.late = max(self.late, monotonic() - due)
                yield due, schedule.picture(number, len(self._pictures))
                number += 1


class _ConnectionHandler(BaseHTTPRequestHandler):
    """One connection."""

    disable_nagle_algorithm = True  # or the end of a frame waits for a delayed acknowledgement: 40 ms

    def __init__(self, broadcast: Broadcast, *arguments: Any) -> None:
        self._broadcast = broadcast
        super().__init__(*arguments)

    def do_GET(self) -> None:
        name = self.path.strip("/")
        if not name.isdigit() or int(name) >= len(self._broadcast.urls):
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "video/x-nut")
        self.end_headers()
        self._broadcast.send(int(name), self.wfile)

    def log_message(self, *_: object) -> None:
        pass


class _WriteOnlyFile:
    """A file that can only be written to, as PyAV takes it; an error in it would be one of FFmpeg's, and unlike others.

    broken  whether the reader has left
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
