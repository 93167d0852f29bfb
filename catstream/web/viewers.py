"""The open pages of a site, and the updates that are sent to them as server-sent events."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from time import monotonic

from starlette.responses import Response, StreamingResponse

from catstream.web.timing import KEEP_ALIVE_SECONDS, RETRY_SECONDS, UPDATE_SECONDS

__all__ = ["Parts", "Viewers"]


class Parts:
    """The state of a page, in parts that are sent to each open page when they have changed.

    Parameters
    ----------
    parts : of each part the function that returns it as JSON values; its argument is the number of changes since the
        page has received it. The parts are sent in this order
    """

    def __init__(self, parts: Mapping[str, Callable[[int], object]]) -> None:
        self._parts = parts
        self._revisions: Counter[str] = Counter()

    def updates(self, seen: dict[str, int]) -> dict[str, object]:
        """Return the parts that have changed since the last call for this page.

        Parameters
        ----------
        seen : revisions that the page has received; empty at first, updated by this call
        """
        news = {name: self._revisions[name] - seen.get(name, 0) for name in self._parts}
        seen.update(self._revisions)
        return {name: part(news[name]) for name, part in self._parts.items() if news[name]}

    def _mark_changed(self, *parts: str) -> None:
        self._revisions.update(parts)


class Viewers:
    """Counts the open pages, and streams updates to them.

    Attributes
    ----------
    count : number of open pages
    closed : whether open pages are to be closed
    """

    def __init__(self) -> None:
        self.count = 0
        self.closed = False
        self._exist = asyncio.Event()

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

    def events(self, page: Parts) -> Response:
        """Return the response to a page that asks for its updates."""
        return StreamingResponse(self._stream(page), media_type="text/event-stream")

    async def _stream(self, page: Parts) -> AsyncIterator[str]:
        seen: dict[str, int] = {}
        last_sent = monotonic()
        with self.counted():
            yield f"retry: {1000 * RETRY_SECONDS:.0f}\n\n"
            while not self.closed:
                if parts := page.updates(seen):
                    last_sent = monotonic()
                    yield _event(parts)
                elif monotonic() - last_sent > KEEP_ALIVE_SECONDS:
                    last_sent = monotonic()
                    yield ":\n\n"
                await asyncio.sleep(UPDATE_SECONDS)
            yield _event({**page.updates(seen), "closed": True})


def _event(parts: dict[str, object]) -> str:
    return f"data: {json.dumps(parts, separators=(',', ':'))}\n\n"
