"""The shutdown of a process of a pipeline: by a signal, by the command `stop`, or because its source ends or fails.

Only this module handles SIGTERM and SIGINT.
"""

from __future__ import annotations

import math
import signal
import time

from catstream.wire.messages import End


class Ending:
    """State of the shutdown: running, then ending for a reason, then ended."""

    def __init__(self) -> None:
        self.reason = ""  #: reason of the shutdown; empty while the process is running
        self.failed = False  #: whether the source failed
        self.ended = False  #: whether the end of the stream was sent or received
        self._signal_time = math.inf  # arrival time of the first signal
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)

    def _handle(self, *_: object) -> None:
        self._signal_time = min(self._signal_time, time.monotonic())
        self.begin("it was stopped")

    def begin(self, reason: str, *, failed: bool = False) -> None:
        """Begin the shutdown. The first reason is kept, unless a later one is a failure of the source."""
        if failed or not self.reason:
            self.reason, self.failed = reason, failed

    def receive(self, end: End) -> None:
        """Record the end of the stream, which was received or sent."""
        self.begin(end.reason, failed=end.failed)
        self.ended = True

    @property
    def signalled(self) -> bool:
        """True if a signal to end the process has arrived."""
        return self.seconds_since_signal >= 0

    @property
    def seconds_since_signal(self) -> float:
        """Seconds since the first signal to end the process; negative before it."""
        return time.monotonic() - self._signal_time
