"""The streams of a fleet: the feed of its page, those of the pages of single streams, and small pictures."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import monotonic

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from catstream.client.registry import Registry, address_of
from catstream.messages.kinds import FleetStatus, Preview, StreamStatus
from catstream.video.annotate import Colours, draw_boxes
from catstream.web.dashboard import FleetDashboard
from catstream.web.feed import Feed, PipelineFeed
from catstream.web.recent import Recent
from catstream.web.timing import (
    FIRST_SECONDS,
    FRESH_SECONDS,
    IDLE_SECONDS,
    NEXT_SECONDS,
    PERIOD_SECONDS,
    REGISTRY_SECONDS,
)
from catstream.wire.channels import PREVIEWS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber
from catstream.wire.readable import readable

_MAX_FEEDS = 32

_WIDTH = 320  # pixels of a small picture
_BURST, _PER_SECOND = 24, 10  # pictures that are made, of all streams together
_KEPT = 1024  # pictures


class FleetFeed(Feed):
    """Asks the registry of a fleet once a second for all streams and nodes.

    Parameters
    ----------
    fleet : address of the fleet, as for `Registry`; the fleet may start later
    keys : folder of the keys of this client, if the fleet requires keys
    """

    dashboard: FleetDashboard
    _pause = PERIOD_SECONDS

    def __init__(self, fleet: str = "", keys: str = "") -> None:
        super().__init__()
        self._fleet, self._keys = fleet, keys
        self._registry: Registry | None = None
        self.dashboard = FleetDashboard()
        self._feeds = StreamFeeds(lambda name: PipelineFeed(address_of(fleet, name), keys))
        self._pictures = Pictures(self._endpoint_of)

    @property
    def problem(self) -> str:
        return "" if self.dashboard.phase == "running" else "the fleet does not answer"

    def pipeline(self, stream: str) -> PipelineFeed:
        feed = self._feeds.open(self._status_of(stream).name)
        if feed is None:
            raise HTTPException(503, "too many pages of streams are open already\n")
        return feed

    async def picture(self, stream: str) -> bytes | None:
        """Return a small picture of the newest frame of a stream as a JPEG file, None if there is none yet."""
        return await self._pictures.get(self._status_of(stream))

    def _status_of(self, stream: str) -> StreamStatus:
        streams = self.dashboard.status.streams
        if stream not in streams:
            raise HTTPException(404, f"this fleet has no stream {stream!r}\n")
        return streams[stream]

    def _endpoint_of(self, stream: StreamStatus) -> Endpoint | None:
        """Return the endpoint of the pipeline of a stream, with the keys to connect with; None if it does not run."""
        return self._registry.endpoint_of(stream) if self._registry is not None else None

    async def _run(self) -> None:
        try:
            with ThreadPoolExecutor(1, "registry") as self._thread:
                await super()._run()
        finally:
            await self._feeds.stop()
            if self._registry is not None:
                self._registry.close()

    async def _feed(self) -> None:
        self._feeds.close_unused()
        status = await asyncio.get_running_loop().run_in_executor(self._thread, self._ask)
        self.dashboard.take(status, monotonic())

    def _ask(self) -> FleetStatus:
        """Return the status of the fleet; called in the thread."""
        if self._registry is None:
            self._registry = Registry(self._fleet, self._keys, timeout=REGISTRY_SECONDS)
        return self._registry.streams()


class StreamFeeds:
    """The feeds of single streams: each is opened by the first request to the page of its stream.

    Parameters
    ----------
    make_feed : returns a feed of the stream with this name
    """

    def __init__(self, make_feed: Callable[[str], PipelineFeed]) -> None:
        self._make_feed = make_feed
        self._open: dict[str, PipelineFeed] = {}

    def __len__(self) -> int:
        return len(self._open)

    def open(self, name: str) -> PipelineFeed | None:
        """Return the feed of a stream, None if too many are open, and somebody looks at each of their pages."""
        if name not in self._open:
            if len(self) >= _MAX_FEEDS:
                self.close_unused(0.0)
            if len(self) >= _MAX_FEEDS:
                return None
            self._open[name] = self._make_feed(name)
            self._open[name].start()
        self._open[name].used = monotonic()
        return self._open[name]

    def close_unused(self, seconds: float = IDLE_SECONDS) -> None:
        """End the feeds that nobody looks at, and to which the last request was so many seconds ago."""
        for name, feed in list(self._open.items()):
            if not feed.viewers and monotonic() - feed.used >= seconds:
                self._open.pop(name).stop()

    async def stop(self) -> None:
        """End all feeds."""
        await asyncio.gather(*(feed.stop() for feed in self._open.values()), return_exceptions=True)
        self._open.clear()


class TokenBucket:
    """Allows bursts of `size` requests, and `rate` requests per second on average."""

    def __init__(self, size: float, rate: float) -> None:
        self._size, self._rate = size, rate
        self._full_at = float("-inf")  # time from which it is full

    def take(self, now: float) -> bool:
        """Count a request; return False, without counting it, if it exceeds the limit."""
        if self._full_at - now > (self._size - 1) / self._rate:
            return False
        self._full_at = max(self._full_at, now) + 1 / self._rate
        return True


class Pictures:
    """Makes small pictures of the newest frames of streams on request, at most ten a second of all streams together.

    Parameters
    ----------
    endpoint_of : returns the endpoint of the pipeline of a stream, None if it does not run
    """

    def __init__(self, endpoint_of: Callable[[StreamStatus], Endpoint | None]) -> None:
        self._endpoint_of = endpoint_of
        self._limit = TokenBucket(_BURST, _PER_SECOND)
        self._kept = Recent[str, tuple[float, bytes]](_KEPT)  # the time at which it was made, and JPEG
        self._pending: dict[str, asyncio.Task[bytes | None]] = {}

    async def get(self, stream: StreamStatus) -> bytes | None:
        """Return the picture of a stream as a JPEG file, None if there is none yet.

        It may be an older one if it is not older than a second, or too many pictures were made in the last second.
        """
        name = stream.name
        made, jpeg = self._kept.get(name, (float("-inf"), None))
        if name not in self._pending:
            if monotonic() - made < FRESH_SECONDS or not self._limit.take(monotonic()):
                return jpeg
            self._pending[name] = asyncio.create_task(self._make(stream))
        return await asyncio.shield(self._pending[name]) or jpeg

    async def _make(self, stream: StreamStatus) -> bytes | None:
        """Make a picture and keep it; return None if the stream does not run, or sends no preview in time."""
        try:
            endpoint = self._endpoint_of(stream)
            preview = await _newest_preview(endpoint) if endpoint is not None else None
            if preview is None:
                return None
            colours = Colours()
            for name in stream.models:  # in the order in which they began, as on the page of the stream
                colours.of(name)
            jpeg = await run_in_threadpool(draw_boxes, preview, colours, _WIDTH)
            self._kept[stream.name] = monotonic(), jpeg
            return jpeg
        finally:
            del self._pending[stream.name]


async def _newest_preview(endpoint: Endpoint) -> Preview | None:
    """Subscribe to the previews of a pipeline for a moment, and return the newest one, None if none arrives in time.

    The first one may be old: the last one is sent again to each new subscriber. The second one is new, but a paused
    pipeline sends none.
    """
    with Subscriber(PREVIEWS, endpoint) as previews:
        first = await _next(previews, FIRST_SECONDS)
        return first and (await _next(previews, NEXT_SECONDS) or first)


async def _next(previews: Subscriber[Preview], seconds: float) -> Preview | None:
    deadline = monotonic() + seconds
    while (preview := previews.receive(0)) is None and monotonic() < deadline:
        await readable([previews.fileno()], deadline - monotonic())
    return preview
