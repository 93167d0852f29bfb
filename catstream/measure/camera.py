"""The camera of a load test: a process that sends a known video over HTTP or RTSP by a schedule.

Each frame is sent when it is due, even if the receiver has not read earlier frames: a slow receiver gets frames late,
but no frame is dropped. The time stamp of a frame in the stream is its due time by `time.monotonic`, from which the
receiver computes its number and its age.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from multiprocessing.connection import Connection
from socketserver import StreamRequestHandler, ThreadingTCPServer
from time import monotonic
from typing import Any, Self

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.system import die_with
from catstream.base.workers import SPAWN, sigint_blocked
from catstream.errors import ServiceError
from catstream.measure.mjpeg import MjpegConnection
from catstream.measure.rtsp import RtspConnection

_STILL_RATE = 25.0  # frames per second of the still image before a schedule begins


@dataclass(frozen=True, slots=True)
class Schedule:
    """The due time of each frame. Before the first frame, a still image is sent.

    start  due time of frame 0, by `time.monotonic`
    rate   frames per second

    >>> clip = Schedule(start=100.0, rate=25.0)
    >>> clip.due(5), clip.number(100.2), clip.following(100.21)
    (100.2, 5, 6)
    """

    start: float
    rate: float

    def due(self, number: int) -> float:
        return self.start + number / self.rate

    def due_times(self, frames: int) -> Float64:
        """Return the due times of the first frames, float64 (frames,)."""
        return self.start + np.arange(frames) / self.rate

    def number(self, moment: float) -> int:
        """Return the frame with the due time nearest to a moment."""
        return round((moment - self.start) * self.rate)

    def following(self, moment: float) -> int:
        """Return the first frame that is due at or after a moment."""
        return math.ceil((moment - self.start) * self.rate)


class Camera:
    """A process with a `Broadcast`, which sends frames on time regardless of other work; a context manager.

    urls : URL of each stream
    """

    def __init__(self, *video: Any) -> None:
        self._pipe, self._other = SPAWN.Pipe()
        self._process = SPAWN.Process(target=_broadcast, args=(self._other, os.getpid(), *video), daemon=True)

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def late(self) -> float:
        """Largest delay in seconds of a frame of the schedule that was not caused by a slow receiver."""
        self._pipe.send(None)
        return float(self._receive())

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Begin a schedule; return the schedule of each stream."""
        self._pipe.send(schedule)
        return list(self._receive())

    def __enter__(self) -> Self:
        with sigint_blocked():
            self._process.start()
        self._other.close()
        self.urls: list[str] = self._receive()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            raise ServiceError("the camera of the load test has exited: its error is printed above") from None


def _broadcast(pipe: Connection, parent: int, *video: Any) -> None:
    die_with(parent)
    with Broadcast(*video) as broadcast:
        pipe.send(broadcast.urls)
        while True:
            schedule = pipe.recv()
            pipe.send(broadcast.late if schedule is None else broadcast.play(schedule))


#: Scheme of the URLs, and handler of a connection, by the name of the source.
_PROTOCOLS: dict[str, tuple[str, type[StreamRequestHandler]]] = {
    "mjpeg": ("http", MjpegConnection),
    "h264": ("rtsp", RtspConnection),
}


class Broadcast(ThreadingTCPServer):
    """Serves streams of the same video on the loopback interface; a context manager.

    `units` are JPEG files for the source mjpeg, and access units for h264, which are sent in a loop. `still` is sent
    before: decoding a keyframe takes several times as long as decoding the unchanged frames after it.

    The schedules of n streams are shifted by 1/n of a frame each, so their frames are due at different times.

    size : (width, height) of an image
    urls : URL of each stream
    late : largest delay in seconds of a sent frame that was not caused by a slow receiver
    """

    daemon_threads = True

    def __init__(
        self, source: str, size: tuple[int, int], units: Sequence[bytes], still: Sequence[bytes] = (), streams: int = 1
    ) -> None:
        protocol, connection = _PROTOCOLS[source]
        super().__init__(("127.0.0.1", 0), connection)
        self.size = size
        self._units, self._still, self._closed = units, still or units[:1], threading.Event()
        self._schedules = [Schedule(math.inf, _STILL_RATE)] * streams
        self.late = 0.0
        self.urls = [f"{protocol}://127.0.0.1:{self.server_address[1]}/{number}" for number in range(streams)]

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Begin a schedule; return the schedule of each stream."""
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

    def frames(self, stream: int) -> Iterator[tuple[float, bytes]]:
        """Yield the due time and the access unit of each frame when it is due, by the newest schedule."""
        while not self._closed.is_set():
            current = self._schedules[stream]
            schedule = replace(current, start=monotonic()) if math.isinf(current.start) else current
            number, still = schedule.following(monotonic()), cycle(self._still)
            while current is self._schedules[stream]:
                due = schedule.due(number)
                if (seconds := due - monotonic()) > 0:
                    if self._closed.wait(min(seconds, 1 / _STILL_RATE)):
                        return
                    if seconds > 1 / _STILL_RATE:
                        continue
                    self.late = max(self.late, monotonic() - due)
                is_before = number < 0 or schedule is not current
                yield due, next(still) if is_before else self._units[number % len(self._units)]
                number += 1
