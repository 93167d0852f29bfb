"""Keeps the state of a page up to date: that of a pipeline, with its messages."""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any

from catstream.box import Box
from catstream.client.control import Control
from catstream.client.registry import locate
from catstream.client.subscription import Subscription
from catstream.errors import CatstreamError
from catstream.messages.kinds import Answer, End, Verb
from catstream.web.dashboard import Dashboard, Parts
from catstream.web.timing import DRAIN_SECONDS, PAUSE_SECONDS, SILENCE_SECONDS
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint

_log = logging.getLogger(__name__)

#: Channels that are always read, and those that are read only while a page is open, because they cost the pipeline
#: processor time.
_PERMANENT, _FOR_VIEWERS = ("tracks", "health", "models"), ("previews", "features")


class Feed(ABC):
    """Keeps a dashboard up to date while it runs, and counts the open pages.

    Attributes
    ----------
    dashboard : the state of the page
    viewers : number of open pages
    """

    dashboard: Parts
    _task: asyncio.Task[None]

    def __init__(self) -> None:
        self.viewers = 0
        self._has_viewers = asyncio.Event()

    @property
    @abstractmethod
    def problem(self) -> str:
        """What is missing until everything runs; empty if nothing is. It names no address, and no stream."""

    @abstractmethod
    def pipeline(self, stream: str) -> PipelineFeed:
        """Return the feed of a stream; this one, if it is that of a pipeline."""

    @contextmanager
    def viewed(self) -> Iterator[None]:
        """Count an open page inside a `with`."""
        self.viewers += 1
        self._has_viewers.set()
        try:
            yield
        finally:
            self.viewers -= 1
            if not self.viewers:
                self._has_viewers.clear()

    def start(self) -> None:
        """Feed the dashboard in a task, until `stop`."""
        self._task = asyncio.create_task(self._run())

    def stop(self) -> asyncio.Task[None]:
        """Return the task, cancelled."""
        self._task.cancel()
        return self._task

    async def _run(self) -> None:
        """Feed the dashboard until cancelled; each error is shown on the page, and then it continues."""
        while True:
            try:
                await self._feed()
            except CatstreamError as error:
                self.dashboard.mark_silent(str(error), monotonic())
            except Exception as error:  # an unexpected error must not end the feed silently
                _log.exception("The page lost what it shows, and tries again.")
                self.dashboard.mark_silent(f"{type(error).__name__}: {error}", monotonic())
            await asyncio.sleep(self._pause)

    #: Seconds between two calls of `_feed`.
    _pause: float

    @abstractmethod
    async def _feed(self) -> None:
        """Feed the dashboard, until the connection is lost or the answer is complete."""


class PipelineFeed(Feed):
    """Receives the messages of a pipeline, and reconnects after each end, silence or restart.

    Parameters
    ----------
    endpoint : endpoint of the pipeline, or address of a stream of a fleet; empty for the only running pipeline of this
        user. It is looked up at each connection
    keys : folder of the keys of this client, if the pipeline requires keys

    Attributes
    ----------
    place : endpoint of the current connection, with its keys; None if there is none
    used : time of the last request to the page, of the monotonic clock
    """

    dashboard: Dashboard
    _pause = PAUSE_SECONDS

    def __init__(self, endpoint: str = "", keys: str = "") -> None:
        super().__init__()
        self._endpoint, self._keys = endpoint, keys
        self.dashboard = Dashboard()
        self.place: Endpoint | None = None
        self.used = monotonic()

    @property
    def problem(self) -> str:
        since, last = monotonic() - SILENCE_SECONDS, self.dashboard.last_reports
        silent = [name for name in CHANNELS["health"].senders if name not in last or last[name] < since]
        return f"no health report from: {', '.join(silent)}" if silent else ""

    def pipeline(self, stream: str) -> PipelineFeed:  # noqa: ARG002  # there is one
        return self

    def execute(self, verb: Verb, object: str, box: Box | None, keep: bool) -> Answer:
        """Send a command to the pipeline, and wait for its answer."""
        with Control(self.place or self._endpoint, keys=self._keys) as pipeline:
            return pipeline.execute(verb, object, box=box, keep=keep)

    async def _feed(self) -> None:
        self.place = await asyncio.to_thread(locate, self._endpoint, self._keys)
        self.dashboard.attach(str(self.place))
        await self._receive(self.place)

    async def _receive(self, place: Endpoint) -> None:
        """Receive all channels until the pipeline ends or is silent."""
        tasks = [asyncio.create_task(self._forward(place, channel)) for channel in (*_PERMANENT, *_FOR_VIEWERS)]
        try:
            done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                self.dashboard.take(task.result(), monotonic())
            # After the end, the last health report, with the final size of the trees, and the last picture may follow.
            await asyncio.wait(rest, timeout=DRAIN_SECONDS)
        finally:
            self.place = None
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _forward(self, place: Endpoint, channel: str) -> End | None:
        """Feed the messages of a channel until the pipeline ends; channels for viewers only while there are viewers."""
        timeout = SILENCE_SECONDS if channel == "health" else None
        while True:
            if channel in _FOR_VIEWERS:
                await self._has_viewers.wait()
            with Subscription[Any](place, channel, timeout=timeout) as messages:
                async for message in messages:
                    self.dashboard.take(message, monotonic(), messages.run)
                    if channel in _FOR_VIEWERS and not self.viewers:
                        break
                else:
                    return messages.end
