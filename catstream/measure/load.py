"""The load of a load test: a pipeline for each stream of the camera."""

from __future__ import annotations

import threading
from contextlib import suppress

from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.client.attach import control
from catstream.errors import CatstreamError, CommandRejectedError, SilenceError
from catstream.measure.load_video import Video
from catstream.pipeline import Pipeline

#: Timeout for a pipeline to start, to answer `stop`, and to end after it.
STOP_SECONDS = 30.0


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    ready : event that is set once the pipeline has started or failed
    address : address of the pipeline, set once it has started
    error : error of a failed pipeline, or None
    totals : totals of the pipeline, set at its end
    """

    address: Address

    def __init__(self, number: int, url: str, video: Video, settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.number = number
        self.ready = threading.Event()
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self._url, self._video = url, video
        self._settings = settings.replace({"run.endpoint": ""})  # a private endpoint for each pipeline
        self._pipeline: Pipeline | None = None

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._video.boxes, self._settings, model=self._video.models) as pipeline:
                self.address = Address(pipeline.endpoint, keys=self._settings.run.keys)
                self._pipeline = pipeline
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
        """End the run as if its source had ended; `join` waits until all features are stored."""
        self.ready.wait(STOP_SECONDS)
        if self._pipeline is not None:
            with (
                suppress(CommandRejectedError, SilenceError),  # it has already ended
                control(self.address, timeout=STOP_SECONDS) as pipeline,
            ):
                pipeline.stop()
