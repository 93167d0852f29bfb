"""Latencies in a histogram of high dynamic range: three digits of each, from a microsecond to an hour."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from hdrh.histogram import HdrHistogram

from catstream.errors import VideoError

__all__ = ["PERCENTILES", "Latencies"]

#: What is told of them, by name.
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}

_LONGEST = 3_600_000_000  # microseconds
_DIGITS = 3


class Latencies:
    """Of some frames, in seconds.

    >>> Latencies([0.010] * 98 + [0.5, 2.0])["p99"]
    0.5
    """

    def __init__(self, seconds: Iterable[float]) -> None:
        self.seconds = np.fromiter(seconds, float)
        self._histogram = HdrHistogram(1, _LONGEST, _DIGITS)
        for microseconds in (self.seconds * 1e6).round().clip(1, _LONGEST).astype(int).tolist():
            self._histogram.record_value(microseconds)

    def __len__(self) -> int:
        return len(self.seconds)

    def __getitem__(self, name: str) -> float:
        """A percentile by its name, NaN where there is no latency."""
        if not len(self):
            return float("nan")
        return float(f"{self._histogram.get_value_at_percentile(PERCENTILES[name]) / 1e6:.{_DIGITS}g}")

    def figures(self) -> dict[str, float | None]:
        """All of `PERCENTILES`, None where there is no latency."""
        return {name: self[name] if len(self) else None for name in PERCENTILES}

    def write(self, path: Path) -> None:
        """Write the distribution of percentiles, in milliseconds, as HdrHistogram's plotter reads it (.hgrm).

        Raises
        ------
        VideoError
            Where the file cannot be written.
        """
        try:
            with path.open("wb") as file:
                self._histogram.output_percentile_distribution(file, 1000.0)
        except OSError as error:
            raise VideoError(f"cannot write {str(path)!r} ({error.strerror}): give another folder") from None
