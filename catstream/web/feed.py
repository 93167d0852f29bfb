"""The feed: takes the messages of a pipeline to the board, however often that comes and goes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from time import monotonic

from catstream.errors import CatstreamError
from catstream.messages import End
from catstream.subscription import subscribe
from catstream.web.board import SILENCE_SECONDS, Board
from catstream.wire.endpoint import find

__all__ = ["Feed"]

_log = logging.getLogger(__name__)

_PAUSE_SECONDS = 0.5
_LAST_SECONDS = 2.0  # that the last messages may take after the end

#: What shows that a pipeline is there, what is taken once it is, and what only while somebody looks: it costs the
#: pipeline something.
_SIGNS, _ALWAYS, _WATCHED = ("tracks", "health"), ("models",), ("previews", "features")


class Feed:
    """Attached for as long as `run` does; finds the pipeline again after each end, silence or restart.

    Parameters
    ----------
    endpoint : where the pipeline runs; empty for the only one of this user, whichever that is by then
    keys : the folder of keys of this client, where the pipeline asks for some

    Attributes
    ----------
    board : what was told
    place, keys : where it is attached, and with which keys; empty while it is not
    viewers : how many pages are open
    closed : whether the pages are to end
    """

    def __init__(self, endpoint: str = "", keys: str = "") -> None:
        self._endpoint, self._keys = endpoint, keys
        self.board = Board()
        self.place = self.keys = ""
        self.viewers = 0
        self.closed = False
        self._watched, self._seen = asyncio.Event(), asyncio.Event()

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Somebody looks: pictures and features are taken meanwhile."""
        self.viewers += 1
        self._watched.set()
        try:
            yield
        finally:
            self.viewers -= 1
            if not self.viewers:
                self._watched.clear()

    async def run(self) -> None:
        """Until it is cancelled."""
        while True:
            try:
                place = find(self._endpoint, self._keys)
                self.place = str(place)
                self.board.attach(self.place)
                self.keys = str(place.keys.folder) if place.keys else ""  # the only one has its keys noted
                await self._attached()
            except CatstreamError as error:
                self.board.lost(str(error))
            except Exception as error:  # whatever it is: nobody would notice a feed that is gone
                _log.exception("The page lost the pipeline, and attaches anew.")
                self.board.lost(f"{type(error).__name__}: {error}")
            self.place = self.keys = ""
            await asyncio.sleep(_PAUSE_SECONDS)

    async def _attached(self) -> None:
        """Until the pipeline ends, or is silent."""
        self._seen.clear()
        tasks = [asyncio.create_task(self._take(channel)) for channel in (*_SIGNS, *_ALWAYS, *_WATCHED)]
        try:
            done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                self.board.take(task.result(), monotonic())
            # It ended: the last health, with what the trees have become, and the last picture may still come.
            await asyncio.wait(rest, timeout=_LAST_SECONDS)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _take(self, channel: str) -> End | None:
        """Until the pipeline ends; what is for viewers only while there are any.

        What says nothing of which pipeline it is from is taken once one is seen: until then, it may be the last message
        of the pipeline before, at the same endpoint.
        """
        timeout = SILENCE_SECONDS if channel == "health" else None
        while True:
            if channel not in _SIGNS:
                await self._seen.wait()
            if channel in _WATCHED:
                await self._watched.wait()
            with subscribe(self.place, channel, timeout=timeout, keys=self.keys) as messages:  # type: ignore[call-overload]
                async for message in messages:
                    self.board.take(message, monotonic())
                    if self.board.standing == "running":
                        self._seen.set()
                    if channel in _WATCHED and not self.viewers:
                        break
                else:
                    end: End | None = messages.end
                    return end
