"""A clock for timeouts that pauses while this process is suspended, by SIGSTOP or in a frozen container."""

from __future__ import annotations

from time import monotonic

STEP_SECONDS = 0.5  #: maximum time that is counted between two calls


class RunningClock:
    """Seconds for which this process has run, if it is called at least every `STEP_SECONDS`.

    A process that resumes reads the time before its messages: by another clock, its timeouts would have expired.
    """

    def __init__(self) -> None:
        self._seconds, self._before = 0.0, monotonic()

    def __call__(self) -> float:
        before, self._before = self._before, monotonic()
        self._seconds += min(self._before - before, STEP_SECONDS)
        return self._seconds
