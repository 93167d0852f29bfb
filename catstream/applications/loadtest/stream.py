"""One stream of a load test: a pipeline, and the thread that owns it."""

from __future__ import annotations

import threading
from contextlib import suppress

from catstream.box import Box
from catstream.client.control import control
from catstream.errors import CatstreamError, CommandRejectedError, SilenceError
from catstream.pipeline import Pipeline
from catstream.settings import Settings

_STOP_SECONDS = 30.0  # time-out for a pipeline to start, to answer `stop`, and to end after it


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    Attributes
    ----------
    endpoint : endpoint of the pipeline, once it is `ready`
    ready : event that is set when the processes are started or the pipeline has failed
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
