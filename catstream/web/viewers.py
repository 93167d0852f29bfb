"""The open pages of a site, and the updates that are sent to them as server-sent events."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from time import monotonic
from typing import Any

from starlette.responses import PlainTextResponse, Response, StreamingResponse

__all__ = ["UPDATE_SECONDS", "Viewers"]

#: Seconds between two updates of an open page.
UPDATE_SECONDS = 0.1

_KEEP_ALIVE_SECONDS = 5.0  # an idle stream sends a comment after this time, which detects closed connections
_MAX_VIEWERS = 64


class Viewers:
    """Counts the open pages of a site, and streams updates to them.

    Attributes
    ----------
    count : number of open pages
    closed : whether open pages are to be closed
    """

    def __init__(self) -> None:
        self.count = 0
        self.closed = False
        self._exist = asyncio.Event()

    def close(self) -> None:
        """End the streams of open pages."""
        self.closed = True

    async def wait(self) -> None:
        """Wait until there is a viewer."""
        await self._exist.wait()

    @contextlib.contextmanager
    def counted(self) -> Iterator[None]:
        """Count a viewer inside a `with`."""
        self.count += 1
        self._exist.set()
        try:
            yield
        finally:
            self.count -= 1
            if not self.count:
                self._exist.clear()

    def too_many(self) -> Response | None:
        """Return an error if too many pages are open."""
        if self.count < _MAX_VIEWERS:
            return None
        return PlainTextResponse(f"{_MAX_VIEWERS} pages or live pictures are open already\n", 503)

    def events(self, updates: Callable[[dict[str, Any]], Mapping[str, object]]) -> Response:
        """Return the response to a page that asks for its updates.

        Parameters
        ----------
        updates : returns the parts that have changed since the last call with the same dictionary, which is empty at
            first and updated by each call
        """
        return self.too_many() or StreamingResponse(self._stream(updates), media_type="text/event-stream")

    async def _stream(self, updates: Callable[[dict[str, Any]], Mapping[str, object]]) -> AsyncIterator[str]:
        known: dict[str, Any] = {}
        last_sent = monotonic()
        with self.counted():
            yield "retry: 1000\n\n"
            while not self.closed:
                if parts := updates(known):
                    last_sent = monotonic()
                    yield _event(parts)
                elif monotonic() - last_sent > _KEEP_ALIVE_SECONDS:
                    last_sent = monotonic()
                    yield ":\n\n"
                await asyncio.sleep(UPDATE_SECONDS)
            yield _event({**updates(known), "closed": True})


def _event(parts: Mapping[str, object]) -> str:
    return f"data: {json.dumps(parts, separators=(',', ':'))}\n\n"
