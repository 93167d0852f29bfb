"""The load: the video that the camera sends, and a pipeline for each stream."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import NamedTuple, cast

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.client.attach import control
from catstream.errors import CatstreamError, CommandRejectedError, SilenceError
from catstream.measure.load_result import Plan, Report
from catstream.pipeline import Pipeline
from catstream.video import rendered
from catstream.video.frames import jpeg
from catstream.video.writer import Encoder

_QUALITY = 90  # of JPEG, as network cameras use it
_STILL_FRAMES = 24  # of which the first is a keyframe
_STOP_SECONDS = 30.0  # timeout for a pipeline to start, to answer `stop`, and to end after it


class Video(NamedTuple):
    """The video that is sent over and over.

    units  JPEG files or access units of H.264, of which the first one is a keyframe
    still  those of the first image over and over, which are sent before
    boxes  boxes of all objects in the first image, by name; the first object is the one whose tracks are measured
    truth  boxes of the first object in all images, float64 (images, 4), NaN if it is absent
    """

    units: list[bytes]
    still: list[bytes]
    boxes: dict[str, Box]
    truth: Float64


def render(plan: Plan, report: Report) -> Video:
    """Render the demo video, forwards, then backwards, and encode it."""
    count, demo = min(plan.frames, 2 * rendered.FRAMES - 2), rendered.Demo(plan.size)
    truth: dict[int, Box | None] = {}

    def images(numbers: Iterable[int]) -> Iterator[np.ndarray]:
        for number in numbers:
            report("rendering", number / count, f"{number} of {count} frames")
            image, truth[number] = demo.image(number)
            yield image

    def encoded(numbers: Iterable[int]) -> Iterator[bytes]:
        if plan.source == "mjpeg":
            yield from (jpeg(image, quality=_QUALITY) for image in images(numbers))
            return
        encoder = Encoder(plan.size, rate=25)
        for image in images(numbers):
            yield from map(bytes, encoder.packets(image))
        yield from map(bytes, encoder.flush())

    still, units = [*encoded([0] * _STILL_FRAMES)], [*encoded(range(count))]
    boxes = _boxes(plan, cast(Box, truth[0]))  # its object is visible
    return Video(units, still, boxes, np.array([truth[number] or (np.nan,) * 4 for number in range(count)]))


def _boxes(plan: Plan, dahlia: Box) -> dict[str, Box]:
    """The boxes in the first image: the flower, and parts of the lake that stay in the picture."""
    if plan.objects == 1:
        return {UNNAMED: dahlia}
    x, y = plan.size[0] / rendered.SIZE[0], plan.size[1] / rendered.SIZE[1]
    lake = (Box(x * (10 + 80 * (n % 4)), y * (110 + 85 * (n // 4)), 60 * x, 60 * y) for n in range(plan.objects - 1))
    return {f"object-{number}": box for number, box in enumerate((dahlia, *lake), 1)}


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    ready : event that is set when the processes are started, so that `address` is set, or the pipeline has failed
    error : the error of a failed pipeline, else None
    totals : as in `Pipeline`, set at the end
    """

    def __init__(self, number: int, url: str, boxes: dict[str, Box], settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.number = number
        self.ready = threading.Event()
        self.address: Address | None = None
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self._url, self._boxes = url, boxes
        self._settings = settings.replace({"run.endpoint": ""})  # each pipeline has its own
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
