"""The test video of a load test, and the camera: a process that sends it to all streams.

It is a process of its own so that frames are sent on time regardless of other work of the load test.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from time import monotonic
from typing import Any, NamedTuple, Self

import numpy as np

from catstream.applications.loadtest.plan import Plan
from catstream.box import Box
from catstream.errors import ServiceError
from catstream.messages.names import UNNAMED
from catstream.numerics.arrays import Float64
from catstream.services.process import SPAWN, die_with, sigint_blocked
from catstream.video import crowd, demo
from catstream.video.broadcast import Broadcast, Schedule
from catstream.video.image import jpeg

_QUALITY = 90  # of JPEG, as network cameras use it


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
        shown = ((image, {UNNAMED: box}) for image, box in demo.render(images, plan.size))
    else:
        shown = crowd.render(plan.objects, images, plan.size)
    for image, boxes in shown:
        files.append(jpeg(image, quality=_QUALITY))
        truth.append(boxes)
        done(len(files))
    name, *_ = first = {name: box for name, box in truth[0].items() if box is not None}
    return Video(files, plan.size, first, np.array([boxes[name] or (np.nan,) * 4 for boxes in truth]))


class Camera:
    """Starts the camera process; a context manager.

    Attributes
    ----------
    video : the images
    urls : URL of each stream
    pid : id of the process
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
        self.play(Schedule(monotonic(), demo.RATE, frames=1))

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
