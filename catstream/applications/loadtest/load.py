"""The load: a camera that sends a rendered video to all streams, a pipeline for each stream, and its subscribers."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, MutableSequence
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from time import monotonic, sleep
from typing import Any, NamedTuple, Self

import numpy as np

from catstream.applications.loadtest import crowd
from catstream.applications.loadtest.broadcast import Broadcast, Schedule
from catstream.applications.loadtest.plan import Plan
from catstream.applications.workers import SPAWN, sigint_blocked
from catstream.box import Box
from catstream.client.control import control
from catstream.errors import CatstreamError, CommandRejectedError, ServiceError, SilenceError
from catstream.messages.kinds import End
from catstream.messages.names import UNNAMED
from catstream.numerics.arrays import Float64
from catstream.pipeline import Pipeline
from catstream.services.process import die_with
from catstream.settings import Settings
from catstream.video import rendered
from catstream.video.frames import jpeg
from catstream.wire.channels import TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import GapCounter, Subscriber

_QUALITY = 90  # of JPEG, as network cameras use it
_STOP_SECONDS = 30.0  # time-out for a pipeline to start, to answer `stop`, and to end after it
_PER_PROCESS = 20  # subscribers in one process, because most machines cannot run a process for each
#: Maximum number of messages that a subscriber reads at once, and seconds between two reads.
_QUICK, _SLOW = (64, 0.05), (1, 0.5)
_DRAIN_SECONDS = 20.0  # time-out for fast subscribers to receive the last messages


class Video(NamedTuple):
    """The images that are sent, forwards, then backwards, and so on.

    files  JPEG files
    size   (width, height) in pixels
    boxes  boxes of all objects in the first image, by name; the first object is the one whose tracks are measured
    truth  boxes of the first object in all images, float64 (images, 4), NaN if it is absent
    """

    files: list[bytes]
    size: tuple[int, int]
    boxes: dict[str, Box]
    truth: Float64


def render(plan: Plan, images: int, done: Callable[[int], None] = lambda _: None) -> Video:
    """Render the first images of the demo video of the objects; `done` is called with their number so far."""
    files, truth = [], []
    shown: Iterator[tuple[np.ndarray, dict[str, Box | None]]]
    if plan.objects == 1:
        shown = ((image, {UNNAMED: box}) for image, box in rendered.render(images, plan.size))
    else:
        shown = crowd.render(plan.objects, images, plan.size)
    for image, boxes in shown:
        files.append(jpeg(image, quality=_QUALITY))
        truth.append(boxes)
        done(len(files))
    name, *_ = first = {name: box for name, box in truth[0].items() if box is not None}
    return Video(files, plan.size, first, np.array([boxes[name] or (np.nan,) * 4 for boxes in truth]))


class Camera:
    """A process that sends the video, so that frames are sent on time regardless of other work; a context manager.

    urls : URL of each stream
    """

    def __init__(self, video: Video, streams: int) -> None:
        self.video = video
        self._pipe, self._other = SPAWN.Pipe()
        arguments = self._other, video.files, video.size, streams, os.getpid()
        self._process = SPAWN.Process(target=_send_video, args=arguments, daemon=True)

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def late(self) -> float:
        """Largest delay in seconds of a frame of this schedule that was not caused by a slow receiver."""
        self._pipe.send(None)
        seconds: float = self._receive()
        return seconds

    def show_still(self) -> None:
        """Send the first image repeatedly, at the frame rate of the video."""
        self.play(Schedule(monotonic(), rendered.RATE, frames=1))

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Send the video by a schedule; return the schedule of each stream."""
        self._pipe.send(schedule)
        schedules: list[Schedule] = self._receive()
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

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            raise ServiceError("the camera of the load test has exited: its error is printed above") from None


def _send_video(pipe: Connection, files: list[bytes], size: tuple[int, int], streams: int, parent: int) -> None:
    die_with(parent)
    with Broadcast(files, size, streams) as broadcast:
        pipe.send(broadcast.urls)
        while True:
            asked = pipe.recv()
            pipe.send(broadcast.late if asked is None else broadcast.play(asked))


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    ready : event that is set when the processes are started, so that `endpoint` is known, or the pipeline has failed
    error : the error of a failed pipeline, else None
    totals : as in `Pipeline`, set at the end
    """

    def __init__(self, number: int, url: str, boxes: dict[str, Box], settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.ready = threading.Event()
        self.endpoint = ""
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self._url, self._boxes, self._settings = url, boxes, settings
        self._pipeline: Pipeline | None = None

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._boxes, self._settings) as pipeline:
                self._pipeline, self.endpoint = pipeline, pipeline.endpoint
                self.ready.set()
                for _ in pipeline:
                    pass
                self.totals = pipeline.totals
        except CatstreamError as error:
            self.error = error
        finally:
            self._pipeline = None
            self.ready.set()

    @property
    def pids(self) -> dict[str, int]:
        """Ids of the running processes, by name."""
        pipeline = self._pipeline
        return pipeline.pids if pipeline is not None else {}

    def stop(self) -> None:
        """End the run as if its source had ended; `join` waits until everything learned is stored."""
        self.ready.wait(_STOP_SECONDS)
        if self.is_alive() and self.endpoint:
            with (
                suppress(CommandRejectedError, SilenceError),  # it has ended by itself
                control(self.endpoint, timeout=_STOP_SECONDS, keys=self._settings.run.keys) as pipeline,
            ):
                pipeline.stop()

    def join(self, timeout: float | None = _STOP_SECONDS) -> None:
        """Wait until the pipeline has ended, which may take some seconds."""
        super().join(timeout)


class Subscribers:
    """Subscribers to the tracks of one pipeline; a context manager.

    They run with idle priority, and the fast ones read twenty times per second, so that they take little processor time
    from the pipeline. `slow` of the `readers` read two messages per second, and `frozen` are stopped by `freeze`.
    """

    def __init__(self, endpoint: str, readers: int, *, slow: int = 0, frozen: int = 0, keys: str = "") -> None:
        self._quick, self._readers = readers - slow - frozen, readers
        self._received, self._missed = (SPAWN.RawArray("l", max(readers, 1)) for _ in range(2))
        self._frozen_since = 0.0  # time of `freeze`
        self._groups: list[list[Any]] = []
        first = 0
        for size, pace in ((self._quick, _QUICK), (slow, _SLOW), (frozen, _QUICK)):
            self._groups.append([])
            for begin in range(first, first + size, _PER_PROCESS):
                numbers = range(begin, min(begin + _PER_PROCESS, first + size))
                arguments = (endpoint, keys, numbers, pace, self._received, self._missed, os.getpid())
                self._groups[-1].append(SPAWN.Process(target=_read_until_end, args=arguments, daemon=True))
            first += size

    @property
    def pids(self) -> list[int]:
        return [process.pid for group in self._groups for process in group]

    @property
    def connected(self) -> bool:
        """Whether each subscriber has received a track."""
        return all(self._received[: self._readers])

    @property
    def frozen_seconds(self) -> float:
        """Seconds since `freeze`, 0 before it."""
        return monotonic() - self._frozen_since if self._frozen_since else 0.0

    def freeze(self) -> None:
        """Stop the processes of the subscribers to be frozen, if all are connected."""
        if not self._frozen_since and self._groups[2] and self.connected:
            for process in self._groups[2]:
                os.kill(process.pid, signal.SIGSTOP)
            self._frozen_since = monotonic()

    def wait(self) -> None:
        """Wait until each fast subscriber has received the end, with a time-out."""
        deadline = monotonic() + _DRAIN_SECONDS
        for process in self._groups[0]:
            process.join(max(0.0, deadline - monotonic()))

    def received(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has received."""
        return list(self._received[: self._quick])

    def missed(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has missed, by the gaps in `seq`."""
        return list(self._missed[: self._quick])

    def __enter__(self) -> Self:
        with sigint_blocked():
            for group in self._groups:
                for process in group:
                    process.start()
        return self

    def __exit__(self, *_: object) -> None:
        for group in self._groups:
            for process in group:
                process.kill()
                process.join()


def _read_until_end(
    endpoint: str,
    keys: str,
    numbers: range,
    pace: tuple[int, float],
    received: MutableSequence[int],
    missed: MutableSequence[int],
    parent: int,
) -> None:
    """Run some of the subscribers until the pipeline ends."""
    die_with(parent)
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with ExitStack() as stack:
        readers = {
            number: stack.enter_context(Subscriber(TRACKS, Endpoint.parse(endpoint, keys))) for number in numbers
        }
        gaps = {number: GapCounter() for number in numbers}
        last = dict.fromkeys(numbers, 0)  # number of the last frame: the tracks of all objects in it have the same
        most, pause = pace
        while readers:
            for number, reader in list(readers.items()):
                for _ in range(most):
                    if (message := reader.receive(0)) is None:
                        break
                    gaps[number].take(message.seq)
                    missed[number] = gaps[number].missed
                    if isinstance(message, End):
                        del readers[number]
                        break
                    if message.seq != last[number]:
                        received[number] += 1
                        last[number] = message.seq
            sleep(pause)
