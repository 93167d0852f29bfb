"""The times of the frames of a file."""

from __future__ import annotations

from fractions import Fraction

#: A larger decrease of time stamps is the beginning of another recording in a joined file.
_JOIN_SECONDS = 1.0


class FrameClock:
    """Gives each decoded frame its time in seconds since the first frame. Times only grow.

    A time is computed as FFmpeg's `best_effort_timestamp`, which PyAV lacks: the time of presentation, or the time of
    decoding if presentation times have decreased more often, for example in files that have times of decoding only.

    In joined recordings, time continues where the time stamps start again. A frame whose time stamp is missing, or does
    not increase, is one frame period after the previous frame.

    rate       frames per second
    time_base  seconds of a tick of the time stamps; None if the container has no time stamps

    >>> clock = FrameClock(25, Fraction(1, 100))
    >>> [round(clock.time(k, pts, None), 2) for k, pts in enumerate([500, 504, 508, 0, 4])]
    [0.0, 0.04, 0.08, 0.12, 0.16]
    """

    def __init__(self, rate: float, time_base: Fraction | None) -> None:
        self._rate, self._time_base = rate, time_base
        self._zero: int | None = None
        self._time = -1 / rate
        self._last_pts = self._last_dts = -(1 << 63)
        self._faulty_pts = self._faulty_dts = 0

    def time(self, number: int, pts: int | None, dts: int | None) -> float:
        """Return the time of frame `number`, the next one, from its time stamps in ticks."""
        if self._time_base is None:
            return number / self._rate
        ticks, following = self._best_effort(pts, dts), self._time + 1 / self._rate
        if ticks is None:
            self._time = following
            return self._time
        self._zero = ticks if self._zero is None else self._zero
        time = float((ticks - self._zero) * self._time_base)
        if time < self._time - _JOIN_SECONDS:
            self._zero = ticks - round(following / self._time_base)
        self._time = time if time > self._time else following
        return self._time

    def _best_effort(self, pts: int | None, dts: int | None) -> int | None:
        if dts is not None:
            self._faulty_dts += dts <= self._last_dts
            self._last_dts = dts
        elif pts is not None:
            self._last_dts = pts
        if pts is not None:
            self._faulty_pts += pts <= self._last_pts
            self._last_pts = pts
        elif dts is not None:
            self._last_pts = dts
        return pts if pts is not None and (dts is None or self._faulty_pts <= self._faulty_dts) else dts
