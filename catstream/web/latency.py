"""The latency of tracks, from the arrival of a frame at the pipeline to the arrival of its track at the page."""

from __future__ import annotations

from time import time

from prometheus_client import Histogram

from catstream.wire.messages import Health, Track

_LATENCIES = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)  # bounds of the histogram, seconds


class Latency:
    """Measures the seconds between the arrival of a live frame and the arrival of its track at this process."""

    def __init__(self) -> None:
        self._zero: tuple[str, float] | None = None  # id of a run, and the Unix time of time 0 of its source
        self.histogram = Histogram(
            "catstream_track_latency_seconds",
            "Seconds from the arrival of a frame of a live source at the pipeline, by the clock of its machine, to the "
            "arrival of its track at this page, for each object.",
            buckets=_LATENCIES,
            registry=None,
        )

    def take(self, message: object, run: str) -> None:
        """Process a message of a run; call this immediately after its arrival."""
        if isinstance(message, Health) and message.process == "detector":
            self._zero = (run, zero) if (zero := message.counters.get("zero_time")) is not None else None
        elif isinstance(message, Track) and self._zero is not None and self._zero[0] == run:
            self.histogram.observe(max(0.0, time() - self._zero[1] - message.time))
