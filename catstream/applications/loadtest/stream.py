"""One stream of a load test: a pipeline, and the thread that owns it."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from time import monotonic

from catstream.box import Box
from catstream.errors import CatstreamError
from catstream.pipeline import Pipeline
from catstream.settings import Settings

__all__ = ["Stream"]

_STOP_SECONDS = 30.0  # time-out for a pipeline to end in order
_RETRY_SECONDS = 3.0  # a detector that was killed before the signal is restarted, and signalled again after this time


class Stream(threading.Thread):
    """Runs a pipeline until `stop` is called: consumes its tracks and supervises its processes.

    Attributes
    ----------
    endpoint : endpoint of the pipeline, once it is `ready`
    ready : event that is set when the processes are started or the pipeline has failed
    error : the error of a failed pipeline, else None
    totals, restarts : as in `Pipeline`, set at the end
    """

    def __init__(self, number: int, url: str, boxes: dict[str, Box], settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.ready = threading.Event()
        self.endpoint = ""
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self.restarts = 0
        self._url, self._boxes, self._settings = url, boxes, settings
        self._pipeline: Pipeline | None = None
        self._signalled: set[int] = set()

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._boxes, self._settings) as pipeline:
                self._pipeline, self.endpoint = pipeline, pipeline.endpoint
                self.ready.set()
                for _ in pipeline:
                    pass
                self.totals, self.restarts = pipeline.totals, pipeline.restarts
        except CatstreamError as error:
            # A detector that is signalled while it resumes exits without an end message.
            self.error = None if self._signalled else error
        finally:
            self._pipeline = None
            self.ready.set()

    @property
    def pids(self) -> dict[str, int]:
        """Ids of the running processes, by name."""
        pipeline = self._pipeline
        return pipeline.pids if pipeline is not None else {}

    def ask_to_stop(self) -> None:
        """Send SIGTERM to the detector: it ends the run once all features that it sent are stored."""
        pid = self.pids.get("detector")
        if pid is not None and pid not in self._signalled:  # a second signal could kill it during its shutdown
            self._signalled.add(pid)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)

    def stop(self) -> None:
        """End the pipeline in order, which may take some seconds."""
        deadline = monotonic() + _STOP_SECONDS
        while self.is_alive() and monotonic() < deadline:
            self.ask_to_stop()
            self.join(_RETRY_SECONDS)
