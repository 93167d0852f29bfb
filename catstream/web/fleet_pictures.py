"""Small pictures of the streams of a fleet, made on request: a stream that nobody looks at sends none."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from time import monotonic

from starlette.concurrency import run_in_threadpool

from catstream.messages.kinds import Preview, StreamStatus
from catstream.video.annotate import draw_boxes
from catstream.video.palette import Colours
from catstream.web.guard import TokenBucket
from catstream.wire.channels import PREVIEWS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber
from catstream.wire.readable import readable

__all__ = ["Pictures"]

_WIDTH = 320  # pixels
_BURST, _PER_SECOND = 24, 10  # pictures that are made, of all streams together
_FRESH_SECONDS = 1.0  # a picture is not made again within this time
_FIRST_SECONDS, _NEXT_SECONDS = 2.0, 0.4  # time-outs for the first and the second preview of a stream
_KEPT = 1024  # pictures


class Pictures:
    """Makes small pictures of the newest frames of streams, at most ten a second of all streams together.

    Parameters
    ----------
    endpoint_of : returns the endpoint of the pipeline of a stream, None if it does not run
    """

    def __init__(self, endpoint_of: Callable[[StreamStatus], Endpoint | None]) -> None:
        self._endpoint_of = endpoint_of
        self._limit = TokenBucket(_BURST, _PER_SECOND)
        self._kept: OrderedDict[str, tuple[float, bytes]] = OrderedDict()  # the time at which it was made, and JPEG
        self._pending: dict[str, asyncio.Task[bytes | None]] = {}

    async def get(self, stream: StreamStatus) -> bytes | None:
        """Return the picture of a stream as a JPEG file, None if there is none yet.

        It may be an older one if it is not older than a second, or too many pictures were made in the last second.
        """
        name = stream.name
        made, jpeg = self._kept.get(name, (float("-inf"), None))
        if name not in self._pending:
            if monotonic() - made < _FRESH_SECONDS or self._limit.wait(monotonic()):
                return jpeg
            self._limit.take()
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
            self._kept.move_to_end(stream.name)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
            return jpeg
        finally:
            del self._pending[stream.name]


async def _newest_preview(endpoint: Endpoint) -> Preview | None:
    """Subscribe to the previews of a pipeline for a moment, and return the newest one, None if none arrives in time.

    The first one may be old: the last one is sent again to each new subscriber. The second one is new, but a paused
    pipeline sends none.
    """
    with Subscriber(PREVIEWS, endpoint) as previews:
        first = await _next(previews, _FIRST_SECONDS)
        return first and (await _next(previews, _NEXT_SECONDS) or first)


async def _next(previews: Subscriber[Preview], seconds: float) -> Preview | None:
    deadline = monotonic() + seconds
    while (preview := previews.receive(0)) is None and monotonic() < deadline:
        await readable([previews], deadline - monotonic())
    return preview
