"""The pages of single streams of a fleet: opened by the first request, closed a while after the last one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic

from starlette.types import ASGIApp

from catstream.web.app import pipeline_app
from catstream.web.feed import Feed

__all__ = ["StreamPages"]

_MAX_PAGES = 32
_IDLE_SECONDS, _CHECK_SECONDS = 60.0, 5.0


@dataclass(slots=True)
class _StreamPage:
    """The page of a stream.

    used  time of the last request to it
    task  runs the feed
    """

    feed: Feed
    app: ASGIApp
    used: float
    task: asyncio.Task[None] | None = None

    def is_unused(self, seconds: float) -> bool:
        """Return whether nobody looks at it, and the last request to it was so many seconds ago."""
        return not self.feed.viewers.count and monotonic() - self.used >= seconds


class StreamPages:
    """The pages of single streams. A page that nobody looks at is closed after a minute.

    Parameters
    ----------
    make_feed : returns a feed of the stream with this name
    """

    def __init__(self, make_feed: Callable[[str], Feed]) -> None:
        self._make_feed = make_feed
        self._pages: dict[str, _StreamPage] = {}

    def __len__(self) -> int:
        return len(self._pages)

    def open(self, name: str) -> ASGIApp | None:
        """Return the application of the page of a stream, None if too many pages are open already."""
        if name not in self._pages:
            if len(self._pages) >= _MAX_PAGES and not self._close_one():
                return None
            feed = self._make_feed(name)
            page = self._pages[name] = _StreamPage(feed, pipeline_app(feed), monotonic())
            page.task = asyncio.create_task(self._run(name, page))
        self._pages[name].used = monotonic()
        return self._pages[name].app

    def close_viewers(self) -> None:
        """Close all pages for those who look at them."""
        for page in self._pages.values():
            page.feed.viewers.close()

    async def stop(self) -> None:
        """End all feeds."""
        tasks = [page.task for page in self._pages.values() if page.task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._pages.clear()  # a task that was cancelled before it began has not done this

    async def _run(self, name: str, page: _StreamPage) -> None:
        """Run the feed of a page until the page is unused for a while."""
        try:
            async with page.feed.running():
                while not page.is_unused(_IDLE_SECONDS):
                    await asyncio.sleep(_CHECK_SECONDS)
        finally:
            if self._pages.get(name) is page:
                del self._pages[name]

    def _close_one(self) -> bool:
        """Close the page that has been unused for longest; return False if all are used."""
        unused = [name for name, page in self._pages.items() if page.is_unused(0.0)]
        if not unused:
            return False
        page = self._pages.pop(min(unused, key=lambda name: self._pages[name].used))
        if page.task is not None:
            page.task.cancel()
        return True
