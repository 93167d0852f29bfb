"""Asks the registry of a fleet for its status once a second, and feeds it to the dashboard."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from time import monotonic

from catstream.client.registry import Registry, address_of
from catstream.errors import CatstreamError
from catstream.messages.kinds import FleetStatus, StreamStatus
from catstream.web.feed import Feed
from catstream.web.fleet_dashboard import FleetDashboard
from catstream.web.viewers import Viewers
from catstream.wire.endpoint import Endpoint

__all__ = ["FleetFeed"]

_log = logging.getLogger(__name__)

_PERIOD_SECONDS, _TIMEOUT_SECONDS = 1.0, 2.0


class FleetFeed:
    """Feeds a dashboard while it runs.

    Parameters
    ----------
    fleet : address of the fleet, as for `Registry`; the fleet may start later
    keys : folder of the keys of this client, if the fleet requires keys

    Attributes
    ----------
    dashboard : the dashboard
    viewers : the open pages
    """

    def __init__(self, fleet: str = "", keys: str = "") -> None:
        self._fleet, self._keys = fleet, keys
        self._registry: Registry | None = None
        self.dashboard = FleetDashboard()
        self.viewers = Viewers()

    def stream(self, name: str) -> StreamStatus | None:
        """Return the last state of a stream, None if the fleet has no such stream."""
        status = self.dashboard.status
        return status.streams.get(name) if status is not None else None

    def endpoint_of(self, stream: StreamStatus) -> Endpoint | None:
        """Return the endpoint of the pipeline of a stream, with the keys to connect with; None if it does not run."""
        return self._registry.place_of(stream).endpoint if self._registry is not None else None

    def feed_of(self, name: str) -> Feed:
        """Return a feed of the pipeline of a stream, also after it has moved."""
        return Feed(address_of(self._fleet, name), self._keys)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run inside an `async with`."""
        with ThreadPoolExecutor(1, "registry") as thread:  # a question waits for its answer
            task = asyncio.create_task(self._run(thread))
            try:
                yield
            finally:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
        if self._registry is not None:
            self._registry.close()

    async def _run(self, thread: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            begun = monotonic()
            try:
                self.dashboard.take(await loop.run_in_executor(thread, self._ask), monotonic())
            except CatstreamError as error:
                self.dashboard.mark_silent(str(error), monotonic())
            except Exception as error:  # an unexpected error must not end the feed silently
                _log.exception("The page lost the fleet and asks again.")
                self.dashboard.mark_silent(f"{type(error).__name__}: {error}", monotonic())
            await asyncio.sleep(max(0.0, begun + _PERIOD_SECONDS - monotonic()))

    def _ask(self) -> FleetStatus:
        """Return the status of the fleet; called in the thread."""
        if self._registry is None:
            self._registry = Registry(self._fleet, self._keys, timeout=_TIMEOUT_SECONDS)
        return self._registry.streams()
