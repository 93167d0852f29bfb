"""The load: the video that the camera sends, a pipeline for each stream, and its subscribers."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, MutableSequence
from contextlib import ExitStack, suppress
from time import monotonic, sleep
from typing import Any, NamedTuple, Self

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.base.workers import SPAWN, die_with, sharing, sigint_blocked
from catstream.client.address import Address
from catstream.client.attach import control
from catstream.errors import CatstreamError, CommandRejectedError, SilenceError
from catstream.loadtest import crowd
from catstream.messages.kinds import End
from catstream.pipeline import Pipeline
from catstream.video import rendered
from catstream.video.frames import jpeg
from catstream.wire.channels import TRACKS
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
    boxes  boxes of all objects in the first image, by name; the first object is the one whose tracks are measured
    truth  boxes of the first object in all images, float64 (images, 4), NaN if it is absent
    """

    files: list[bytes]
    boxes: dict[str, Box]
    truth: Float64


def render(objects: int, images: int, size: tuple[int, int], done: Callable[[int], None]) -> Video:
    """Render the first images of the demo video of so many objects; `done` is called with their number so far."""
    files, truth = [], []
    frames: Iterator[tuple[np.ndarray, dict[str, Box | None]]]
    if objects == 1:
        frames = ((image, {UNNAMED: box}) for image, box in rendered.render(images, size))
    else:
        frames = crowd.render(objects, images, size)
    for image, boxes in frames:
        files.append(jpeg(image, quality=_QUALITY))
        truth.append(boxes)
        done(len(files))
    name, *_ = first = {name: box for name, box in truth[0].items() if box is not None}
    return Video(files, first, np.array([boxes[name] or (np.nan,) * 4 for boxes in truth]))


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    ready : event that is set when the processes are started, so that `address` is set, or the pipeline has failed
    error : the error of a failed pipeline, else None
    totals : as in `Pipeline`, set at the end
    """

    def __init__(self, number: int, url: str, boxes: dict[str, Box], settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.ready = threading.Event()
        self.address: Address | None = None
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self._url, self._boxes, self._settings = url, boxes, settings
        self._pipeline: Pipeline | None = None

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._boxes, self._settings) as pipeline:
                self._pipeline = pipeline
                self.address = Address(pipeline.endpoint, keys=self._settings.run.keys)
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
        if self.is_alive() and self.address is not None:
            with (
                suppress(CommandRejectedError, SilenceError),  # it has ended by itself
                control(self.address, timeout=_STOP_SECONDS) as pipeline,
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

    def __init__(self, address: Address, readers: int, *, slow: int = 0, frozen: int = 0) -> None:
        self._quick, self._readers = readers - slow - frozen, readers
        with sharing():
            self._received, self._missed = (SPAWN.RawArray("l", max(readers, 1)) for _ in range(2))
        self._frozen_since = 0.0  # time of `freeze`

        def processes(numbers: range, pace: tuple[int, float]) -> list[Any]:
            parts = [numbers[begin : begin + _PER_PROCESS] for begin in range(0, len(numbers), _PER_PROCESS)]
            rest = pace, self._received, self._missed, os.getpid()
            return [SPAWN.Process(target=_read_until_end, args=(address, part, *rest), daemon=True) for part in parts]

        self._fast = processes(range(self._quick), _QUICK)
        self._frozen = processes(range(readers - frozen, readers), _QUICK)
        self._all = [*self._fast, *processes(range(self._quick, self._quick + slow), _SLOW), *self._frozen]

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._all]

    @property
    def connected(self) -> bool:
        """True if each subscriber has received a track."""
        return all(self._received[: self._readers])

    @property
    def frozen_seconds(self) -> float:
        """Seconds since `freeze`, 0 before it."""
        return monotonic() - self._frozen_since if self._frozen_since else 0.0

    def freeze(self) -> None:
        """Stop the processes of the subscribers to be frozen, if all are connected."""
        if not self._frozen_since and self._frozen and self.connected:
            for process in self._frozen:
                os.kill(process.pid, signal.SIGSTOP)
            self._frozen_since = monotonic()

    def wait(self) -> None:
        """Wait until each fast subscriber has received the end, with a time-out."""
        deadline = monotonic() + _DRAIN_SECONDS
        for process in self._fast:
            process.join(max(0.0, deadline - monotonic()))

    def received(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has received."""
        return list(self._received[: self._quick])

    def missed(self) -> list[int]:
        """Return the number of frames whose tracks each fast subscriber has missed, by the gaps in `frame`."""
        return list(self._missed[: self._quick])

    def __enter__(self) -> Self:
        with sigint_blocked():
            for process in self._all:
                process.start()
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._all:
            process.kill()
            process.join()


def _read_until_end(
    address: Address,
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
        endpoint = address.resolve()
        readers = {number: stack.enter_context(Subscriber(TRACKS, endpoint)) for number in numbers}
        gaps = {number: GapCounter() for number in numbers}
        last = dict.fromkeys(numbers, 0)  # number of the last frame: the tracks of all objects in it have the same
        most, pause = pace
        while readers:
            for number, reader in list(readers.items()):
                for _ in range(most):
                    if (message := reader.receive(0)) is None:
                        break
                    if isinstance(message, End):
                        gaps[number].end(message)
                        missed[number] = gaps[number].missed
                        del readers[number]
                        break
                    gaps[number].take(message)
                    missed[number] = gaps[number].missed
                    received[number] += message.seq != last[number]
                    last[number] = message.seq
            sleep(pause)
