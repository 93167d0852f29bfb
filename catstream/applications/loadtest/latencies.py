"""Latencies in an HDR histogram, from a microsecond to an hour with three significant digits."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from hdrh.histogram import HdrHistogram

from catstream.errors import VideoError

__all__ = ["PERCENTILES", "Latencies"]

#: The percentiles that are reported, by name.
PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}

_LONGEST = 3_600_000_000  # microseconds
_DIGITS = 3
_STEPS = 10  # of the distribution, between one share of the frames and the half of the rest


class Latencies:
    """The latencies of some frames in seconds.

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
        """Return a percentile by its name, NaN if there are no latencies."""
        if not len(self):
            return float("nan")
        return float(f"{self._histogram.get_value_at_percentile(PERCENTILES[name]) / 1e6:.{_DIGITS}g}")

    def figures(self) -> dict[str, float | None]:
        """Return all `PERCENTILES`, None if there are no latencies."""
        return {name: self[name] if len(self) else None for name in PERCENTILES}

    def distribution(self) -> tuple[np.ndarray, np.ndarray]:
        """Return percentiles as shares from 0 to 1, denser towards 1, and the latencies in seconds."""
        steps = self._histogram.get_percentile_iterator(_STEPS)  # yields one object, which it changes
        found = np.array([(step.percentile_level_iterated_to, step.value_iterated_to) for step in steps], float)
        return found[:, 0] / 100, found[:, 1] / 1e6

    def write(self, path: Path) -> None:
        """Write the percentile distribution in milliseconds, in the .hgrm format of HdrHistogram's plotter.

        Raises
        ------
        VideoError
            If the file cannot be written.
        """
        try:
            with path.open("wb") as file:
                self._histogram.output_percentile_distribution(file, 1000.0)
        except OSError as error:
            raise VideoError(f"cannot write {str(path)!r} ({error.strerror}): give another folder") from None
