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

_STOP_SECONDS = 30.0
_RETRY_SECONDS = 3.0  # one that was killed before it was told is restarted, and told then


class Stream(threading.Thread):
    """Runs a pipeline until it is told to `stop`: takes its results, and keeps its processes alive.

    Attributes
    ----------
    endpoint : where it meets, once it is `ready`
    ready : set when its processes are started, or it has failed
    error : why it failed, None where it has not
    totals, restarts : as a `Pipeline` has them
    """

    def __init__(self, number: int, url: str, box: Box, settings: Settings) -> None:
        super().__init__(name=f"stream {number}", daemon=True)
        self.ready = threading.Event()
        self.endpoint = ""
        self.error: CatstreamError | None = None
        self.totals: dict[str, int] = {}
        self.restarts = 0
        self._url, self._box, self._settings = url, box, settings
        self._pipeline: Pipeline | None = None
        self._signalled: set[int] = set()

    def run(self) -> None:
        try:
            with Pipeline(self._url, self._box, self._settings) as pipeline:
                self._pipeline, self.endpoint = pipeline, pipeline.endpoint
                self.ready.set()
                for _ in pipeline:
                    pass
                self.totals, self.restarts = pipeline.totals, pipeline.restarts
        except CatstreamError as error:
            # A detector that is told to stop while it resumes has nothing to end.
            self.error = None if self._signalled else error
        finally:
            self._pipeline = None
            self.ready.set()

    @property
    def pids(self) -> dict[str, int]:
        """Process id by name, of those that run now."""
        pipeline = self._pipeline
        return pipeline.pids if pipeline is not None else {}

    def ask_to_stop(self) -> None:
        """Tell the detector that no more frames are wanted: it ends when all that it sent is stored."""
        pid = self.pids.get("detector")
        if pid is not None and pid not in self._signalled:  # a second signal would find it on its way out, and deaf
            self._signalled.add(pid)
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGTERM)

    def stop(self) -> None:
        """End the pipeline in order, which may take a while."""
        deadline = monotonic() + _STOP_SECONDS
        while self.is_alive() and monotonic() < deadline:
            self.ask_to_stop()
            self.join(_RETRY_SECONDS)
