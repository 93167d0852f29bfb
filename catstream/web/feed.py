"""Keeps the state of a page up to date: a thread reads the messages of a pipeline.

The thread reads with the public client API, and passes each message to the event loop of the server, which alone uses
the dashboard.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from time import monotonic
from typing import Any, cast

from catstream.client.address import Address
from catstream.client.control import Control
from catstream.client.subscription import Subscription
from catstream.errors import CatstreamError, SilenceError
from catstream.web.dashboard import Dashboard
from catstream.web.latency import Latency
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import Answer, End

_log = logging.getLogger(__name__)

SILENCE_SECONDS = 4.0  #: without a health report, after which a process is silent; each sends one every second
DRAIN_SECONDS = 2.0  #: for the last messages to arrive after the end
PAUSE_SECONDS = 0.5  #: before a pipeline is looked up again
READ_SECONDS = 0.03  #: between two reads of all channels but the tracks, which are awaited
STOP_SECONDS = 2.0  #: for the thread to end
PICTURE_SECONDS = 5.0  #: after a request for a picture, for which pictures are received


class PipelineFeed:
    """Receives the messages of a pipeline from `start` to `stop`, and reconnects after each end, silence or restart.

    Previews, which cost the pipeline processor time, are received only while a page is open, or a wall asks for
    pictures. The `address` is resolved at each connection, first after `start`.
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self._endpoint: Endpoint | None = None  # of the current connection, with its keys
        self._has_end = threading.Event()
        self.viewers = 0  #: open pages
        self.pictured = -inf  #: time of the last request for a picture
        self.dashboard = Dashboard()
        self.latency = Latency()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    @contextmanager
    def viewed(self) -> Iterator[None]:
        """Count an open page inside a `with`."""
        self.viewers += 1
        try:
            yield
        finally:
            self.viewers -= 1

    def start(self) -> None:
        """Start the thread; called in the event loop."""
        self._loop = asyncio.get_running_loop()
        self._thread.start()

    def end(self) -> None:
        """Ask the thread to end; it may still wait for an answer."""
        self._stopped.set()

    def stop(self) -> None:
        """End the thread, and wait for it for at most `STOP_SECONDS`."""
        self.end()
        self._thread.join(STOP_SECONDS)

    @property
    def problem(self) -> str:
        """Why no frames are tracked; empty if they are. It contains no address, because anyone may request it."""
        since, last = monotonic() - SILENCE_SECONDS, self.dashboard.last_reports
        silent = [name for name in CHANNELS["health"].senders if name not in last or last[name] < since]
        state, words = self.dashboard.state
        if silent and state != "ended":
            return f"no health report from: {', '.join(silent)}"
        return "" if state == "running" else words

    def wait_for_end(self) -> None:
        """Wait at most `DRAIN_SECONDS` for the end of the pipeline; called before the server is stopped."""
        self._has_end.wait(DRAIN_SECONDS)

    def execute(self, **command: Any) -> Answer:
        """Send a command, by its fields, to the pipeline, and wait for its answer."""
        with Control(self._endpoint or self.address.resolve()) as pipeline:
            return pipeline.execute(**command)

    def _run(self) -> None:
        """Feed the dashboard until `stop`; each error is shown on the page, and then it continues."""
        while not self._stopped.is_set():
            try:
                self._feed()
            except CatstreamError as error:
                self._call(self.dashboard.mark_silent, str(error))
            except Exception as error:  # an unexpected error must not end the feed silently
                _log.exception("The page lost what it shows, and tries again.")
                self._call(self.dashboard.mark_silent, f"{type(error).__name__}: {error}")
            self._stopped.wait(PAUSE_SECONDS)

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function in the event loop, which may have ended."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    def _feed(self) -> None:
        """Feed the dashboard until the connection is lost."""
        self._endpoint = self.address.resolve()
        self._call(self.dashboard.attach, str(self._endpoint))
        subscriptions: dict[str, Subscription[Any]] = {}
        try:
            for channel, timeout in (("tracks", READ_SECONDS), ("health", 0.0), ("models", 0.0)):
                subscriptions[channel] = Subscription(self._endpoint, channel, timeout=timeout)
            self._receive(self._endpoint, subscriptions)
        finally:
            self._endpoint = None
            for subscription in subscriptions.values():
                subscription.close()

    def _receive(self, endpoint: Endpoint, subscriptions: dict[str, Subscription[Any]]) -> None:
        """Receive all channels until the pipeline ends or is silent; a channel that has ended is removed."""
        last_report, next_read = monotonic(), 0.0
        over = inf  # after the first end, when to stop waiting for the last messages of the others
        silence = (
            f"Waiting for the first health report from {endpoint}. The first start after an installation compiles "
            "kernels, which takes about 10 s."
        )
        while subscriptions and (now := monotonic()) < over and not self._stopped.is_set():
            # Step 1: receive pictures only while they are looked at.
            is_watched = self.viewers or now - self.pictured < PICTURE_SECONDS
            if is_watched and over == inf and "previews" not in subscriptions:
                subscriptions["previews"] = Subscription(endpoint, "previews", timeout=0.0)
            elif not is_watched and "previews" in subscriptions:
                subscriptions.pop("previews").close()
            # Step 2: wait for a track; look at the other channels less often than tracks may arrive.
            channels = [*subscriptions.keys() & {"tracks"}]
            if now >= next_read:
                channels, next_read = [*subscriptions], now + READ_SECONDS
            for channel in channels:
                if (message := _next(subscriptions[channel])) is None:
                    continue
                now = monotonic()
                self.latency.take(message, subscriptions[channel].run)
                if over == inf or not isinstance(message, End):  # the next pipeline may have begun at this endpoint
                    self._call(self.dashboard.take, message, now, subscriptions[channel].run)
                if channel == "health":
                    last_report = now
                    silence = f"no health report arrived from {endpoint} within {SILENCE_SECONDS:g} s"
                if isinstance(message, End):
                    # The last health report, with the final size of the trees, and the last picture may follow.
                    over = min(over, now + DRAIN_SECONDS)
                    self._has_end.set()
                    subscriptions.pop(channel).close()
            # Step 3: without health reports, the pipeline is silent.
            if over == inf and monotonic() - last_report > SILENCE_SECONDS:
                raise SilenceError(silence)
            if "tracks" not in subscriptions:  # nothing else waits
                self._stopped.wait(READ_SECONDS)


def _next(messages: Subscription[Any]) -> object | None:
    """Return the next message, at last the end; None if none arrives within the timeout of the subscription."""
    with suppress(SilenceError):
        for message in messages:
            return cast(object, message)
        return messages.end
    return None
