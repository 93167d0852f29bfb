"""The camera of a load test: a process that renders the demo video once and sends it to all streams.

It is a process of its own so that frames are sent on time regardless of other work of the load test.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from time import monotonic
from typing import Any, Self

import numpy as np

from catstream.applications.loadtest.children import SPAWN, start
from catstream.applications.loadtest.objects import several
from catstream.box import Box
from catstream.errors import ServiceError
from catstream.services.loop import die_with
from catstream.video import demo
from catstream.video.broadcast import Broadcast, Schedule, jpeg

__all__ = ["Camera"]


class Camera:
    """Starts the camera process; a context manager.

    Parameters
    ----------
    streams : number of streams
    size : (width, height) of a frame in pixels
    pictures : number of different images to render; a longer video repeats them backwards, then forwards again
    objects : number of objects

    Attributes
    ----------
    urls : URL of each stream; set by `render`
    truth : ground truth box of the object without a name in each image, float64 (pictures, 4), NaN if it is absent; set
        by `render`
    boxes : boxes of all objects in the still image that is shown before the start, by name; set by `render`
    pid : id of the process
    """

    def __init__(self, streams: int, size: tuple[int, int], pictures: int, objects: int = 1) -> None:
        self._pipe, other = SPAWN.Pipe()
        arguments = other, streams, size, pictures, objects, os.getpid()
        self._process = SPAWN.Process(target=_run_camera, args=arguments)
        self._other = other

    def render(self, done: Callable[[int], None] = lambda _: None) -> None:
        """Wait until all images are rendered; `done` is called with their number so far."""
        while isinstance(message := self._receive(), int):
            done(message)
        self.urls, truth, self.boxes = message
        self.truth = np.array([box or (np.nan,) * 4 for box in truth])

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
        start(self._process)
        self._other.close()
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


def _run_camera(
    pipe: Connection, streams: int, size: tuple[int, int], pictures: int, objects: int, parent: int
) -> None:
    die_with(parent)
    files: list[bytes] = []
    truth: list[Box | None] = []
    boxes: dict[str, Box] = {}
    for image, box in demo.render(pictures, size):
        if box is not None and not truth:
            boxes = several(image, box, objects)
        files.append(jpeg(image))
        truth.append(box)
        pipe.send(len(files))
    with Broadcast(files, size, streams) as broadcast:
        pipe.send((broadcast.urls, truth, boxes))
        while True:
            asked = pipe.recv()
            pipe.send(broadcast.late if asked is None else broadcast.play(asked))
