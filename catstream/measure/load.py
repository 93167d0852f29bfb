"""The load: a pipeline for each stream of the camera."""

from __future__ import annotations

import threading
from contextlib import suppress

from catstream.base.settings import Settings
from catstream.client.address import Address
from catstream.client.attach import control
from catstream.errors import CatstreamError, CommandRejectedError, SilenceError
from catstream.measure.load_video import Video
from catstream.pipeline import Pipeline

_STOP_SECONDS = 30.0  # timeout for a pipeline to start, to answer `stop`, and to end after it


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    ready : event that is set when the processes are started, so that `address` is set, or the pipeline has failed
    error : the error of a failed pipeline, else None
    totals : as in `Pipeline`, set at the end
    """

    def __init__(self, number: int, url: str, video: Video, settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.number = number
        self.ready = threading.Event()
        self.address: Address | None = None
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self._url, self._video = url, video
        self._settings = settings.replace({"run.endpoint": ""})  # each pipeline has its own
        self._pipeline: Pipeline | None = None

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._video.boxes, self._settings, model=self._video.models) as pipeline:
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
