"""Feeds the messages of a pipeline to the dashboard, and reconnects after each end, silence or restart."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from time import monotonic

from catstream.client.control import Control
from catstream.client.registry import locate
from catstream.client.subscription import AnyMessage, Subscription
from catstream.errors import CatstreamError
from catstream.messages.kinds import End
from catstream.web.dashboard import SILENCE_SECONDS, Dashboard
from catstream.web.viewers import Viewers
from catstream.wire.endpoint import Endpoint

__all__ = ["Feed"]

_log = logging.getLogger(__name__)

_PAUSE_SECONDS = 0.5
_DRAIN_SECONDS = 2.0  # time for the last messages to arrive after the end

#: Channels that show that a pipeline runs; those that are read while it runs; and those that are read only while a page
#: is open, because they cost the pipeline processor time.
_LIVENESS, _PERMANENT, _FOR_VIEWERS = ("tracks", "health"), ("models",), ("previews", "features")


class Feed:
    """Feeds a dashboard while `run` runs.

    Parameters
    ----------
    endpoint : endpoint of the pipeline, or address of a stream of a fleet; empty for the only running pipeline of this
        user. It is looked up at each connection
    keys : folder of the keys of this client, if the pipeline requires keys

    Attributes
    ----------
    dashboard : the dashboard
    place : endpoint of the current connection, with its keys; None if there is none
    viewers : the open pages; pictures and features are received while there is one
    """

    def __init__(self, endpoint: str = "", keys: str = "") -> None:
        self._endpoint, self._keys = endpoint, keys
        self.dashboard = Dashboard()
        self.place: Endpoint | None = None
        self.viewers = Viewers()
        self._is_running = asyncio.Event()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run inside an `async with`."""
        task = asyncio.create_task(self.run())
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def control(self) -> Control:
        """Connect to the pipeline to send commands."""
        return Control(self.place or self._endpoint, keys=self._keys)

    async def run(self) -> None:
        """Connect, and reconnect after each loss, until cancelled."""
        while True:
            try:
                self.place = await asyncio.to_thread(locate, self._endpoint, self._keys)
                self.dashboard.attach(str(self.place))
                await self._run_attached(self.place)
            except CatstreamError as error:
                self.dashboard.mark_silent(str(error))
            except Exception as error:  # an unexpected error must not end the feed silently
                _log.exception("The page lost the pipeline and reconnects.")
                self.dashboard.mark_silent(f"{type(error).__name__}: {error}")
            self.place = None
            await asyncio.sleep(_PAUSE_SECONDS)

    async def _run_attached(self, place: Endpoint) -> None:
        """Receive all channels until the pipeline ends or is silent."""
        self._is_running.clear()
        tasks = [
            asyncio.create_task(self._forward(place, channel)) for channel in (*_LIVENESS, *_PERMANENT, *_FOR_VIEWERS)
        ]
        try:
            done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                self.dashboard.take(task.result(), monotonic())
            # After the end, the last health report, with the final size of the trees, and the last picture may follow.
            await asyncio.wait(rest, timeout=_DRAIN_SECONDS)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _forward(self, place: Endpoint, channel: str) -> End | None:
        """Feed the messages of a channel until the pipeline ends; channels for viewers only while there are viewers.

        The other channels are read only once the pipeline runs: before, they could give the last message of the
        previous pipeline at the same endpoint.
        """
        timeout = SILENCE_SECONDS if channel == "health" else None
        while True:
            if channel not in _LIVENESS:
                await self._is_running.wait()
            if channel in _FOR_VIEWERS:
                await self.viewers.wait()
            with Subscription[AnyMessage](place, channel, timeout=timeout) as messages:
                async for message in messages:
                    self.dashboard.take(message, monotonic(), messages.run)
                    if self.dashboard.phase == "running":
                        self._is_running.set()
                    if channel in _FOR_VIEWERS and not self.viewers.count:
                        break
                else:
                    return messages.end
