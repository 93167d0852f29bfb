"""A clock for time limits that stands still while this process is stopped: by SIGSTOP, or in a frozen container."""

from __future__ import annotations

from time import monotonic

STEP_SECONDS = 0.5  #: the most that counts between two calls


class RunningClock:
    """Seconds in which this process ran, if it is called at least every `STEP_SECONDS`.

    A process that was stopped reads the time first when it continues: a limit would be over although nothing that it
    waits for could arrive.
    """

    def __init__(self) -> None:
        self._seconds, self._before = 0.0, monotonic()

    def __call__(self) -> float:
        before, self._before = self._before, monotonic()
        self._seconds += min(self._before - before, STEP_SECONDS)
        return self._seconds
