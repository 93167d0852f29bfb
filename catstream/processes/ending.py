"""Why and how far a process of a pipeline has ended.

Only this module handles the signals that ask a process to end; the command `stop`, and a source that ends or fails, end
a process here.
"""

from __future__ import annotations

import math
import signal
import time

from catstream.wire.messages import End


class Ending:
    """A process is running, then ending for a reason, and has ended.

    reason  why no more frames are tracked; empty while the process is running
    failed  whether the source failed
    ended   whether the end of the stream was sent or received
    """

    def __init__(self) -> None:
        self.reason, self.failed, self.ended = "", False, False
        self._signal_time = math.inf  # at which the first signal arrived
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)

    def _handle(self, *_: object) -> None:
        self._signal_time = min(self._signal_time, time.monotonic())
        self.begin("it was stopped")

    def begin(self, reason: str, *, failed: bool = False) -> None:
        """End for a reason. The first one counts; but a source that fails is always an error."""
        if failed or not self.reason:
            self.reason, self.failed = reason, failed

    def receive(self, end: End) -> None:
        """Note the end of the stream, which was received or sent."""
        self.begin(end.reason, failed=end.failed)
        self.ended = True

    @property
    def signalled(self) -> bool:
        """True if a signal has asked the process to end."""
        return self.seconds_since_signal >= 0

    @property
    def seconds_since_signal(self) -> float:
        """Seconds since a signal asked the process to end; negative if none has."""
        return time.monotonic() - self._signal_time
