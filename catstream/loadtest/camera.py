"""The camera: a process that renders the demo's video once, and broadcasts it to all streams.

By itself, so that frames leave when they are due whatever else the load test is busy with.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from time import monotonic
from typing import Any, Self

import numpy as np

from catstream.box import Box
from catstream.errors import ServiceError
from catstream.loadtest.children import SPAWN, start
from catstream.services.loop import die_with
from catstream.video import demo
from catstream.video.broadcast import Broadcast, Schedule, jpeg

__all__ = ["Camera"]


class Camera:
    """Runs while it is open.

    Parameters
    ----------
    streams : how many it broadcasts
    size : (width, height) of a frame, pixels
    pictures : different frames to render; a longer video shows them backwards, then forwards again

    Attributes
    ----------
    urls : of each stream; known once it has rendered
    truth : float64 (pictures, 4), the object's box in each picture, NaN where it is absent
    pid : of its process
    """

    def __init__(self, streams: int, size: tuple[int, int], pictures: int) -> None:
        self._pipe, other = SPAWN.Pipe()
        self._process = SPAWN.Process(target=_run_camera, args=(other, streams, size, pictures, os.getpid()))
        self._other = other

    def render(self, done: Callable[[int], None] = lambda _: None) -> None:
        """Wait until all is rendered; `done` is called with the number of pictures so far."""
        while isinstance(message := self._receive(), int):
            done(message)
        self.urls, boxes = message
        self.truth = np.array([box or (np.nan,) * 4 for box in boxes])

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    @property
    def box(self) -> Box:
        """The object in the picture that is shown before the start."""
        return Box(*self.truth[0].tolist())

    @property
    def late(self) -> float:
        """Seconds by which it sent a frame of this schedule too late at most, by its own fault."""
        self._pipe.send(None)
        return self._receive()

    def show_still(self) -> None:
        """Show the first picture, at the video's own rate."""
        self.play(Schedule(monotonic(), demo.RATE, frames=1))

    def play(self, schedule: Schedule) -> list[Schedule]:
        """Show the video from the start of a schedule on; returns the schedule of each stream."""
        self._pipe.send(schedule)
        return self._receive()

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
            raise ServiceError("the camera of the load test has died: its last words are above") from None


def _run_camera(pipe: Connection, streams: int, size: tuple[int, int], pictures: int, parent: int) -> None:
    die_with(parent)
    files, boxes = [], []
    for image, box in demo.render(pictures, size):
        files.append(jpeg(image))
        boxes.append(box)
        pipe.send(len(files))
    with Broadcast(files, size, streams) as broadcast:
        pipe.send((broadcast.urls, boxes))
        while True:
            asked = pipe.recv()
            pipe.send(broadcast.late if asked is None else broadcast.play(asked))
