"""The feed: takes the messages of a pipeline to the dashboard, however often that comes and goes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from time import monotonic

from catstream.errors import CatstreamError
from catstream.messages import End
from catstream.subscription import subscribe
from catstream.web.dashboard import SILENCE_SECONDS, Dashboard
from catstream.wire.endpoint import find

__all__ = ["Feed"]

_log = logging.getLogger(__name__)

_PAUSE_SECONDS = 0.5
_DRAIN_SECONDS = 2.0  # that the last messages may take after the end

#: What shows that a pipeline is there, what is taken once it is, and what only while somebody looks: it costs the
#: pipeline something.
_LIVENESS, _PERMANENT, _FOR_VIEWERS = ("tracks", "health"), ("models",), ("previews", "features")


class Feed:
    """Attached for as long as `run` does; finds the pipeline again after each end, silence or restart.

    Parameters
    ----------
    endpoint : where the pipeline runs; empty for the only one of this user, whichever that is by then
    keys : the folder of keys of this client, where the pipeline asks for some

    Attributes
    ----------
    dashboard : what was told
    attached_endpoint, keys : where it is attached, and with which keys; empty while it is not
    viewers : how many pages are open
    closed : whether the pages are to end
    """

    def __init__(self, endpoint: str = "", keys: str = "") -> None:
        self._endpoint, self._keys = endpoint, keys
        self.dashboard = Dashboard()
        self.attached_endpoint = self.keys = ""
        self.viewers = 0
        self.closed = False
        self._has_viewers, self._is_running = asyncio.Event(), asyncio.Event()

    @contextlib.contextmanager
    def viewer(self) -> Iterator[None]:
        """Somebody looks: pictures and features are taken meanwhile."""
        self.viewers += 1
        self._has_viewers.set()
        try:
            yield
        finally:
            self.viewers -= 1
            if not self.viewers:
                self._has_viewers.clear()

    async def run(self) -> None:
        """Until it is cancelled."""
        while True:
            try:
                attached_endpoint = find(self._endpoint, self._keys)
                self.attached_endpoint = str(attached_endpoint)
                self.dashboard.attach(self.attached_endpoint)
                self.keys = (
                    str(attached_endpoint.keys.folder) if attached_endpoint.keys else ""
                )  # the only one has its keys noted
                await self._run_attached()
            except CatstreamError as error:
                self.dashboard.mark_silent(str(error))
            except Exception as error:  # whatever it is: nobody would notice a feed that is gone
                _log.exception("The page lost the pipeline, and attaches anew.")
                self.dashboard.mark_silent(f"{type(error).__name__}: {error}")
            self.attached_endpoint = self.keys = ""
            await asyncio.sleep(_PAUSE_SECONDS)

    async def _run_attached(self) -> None:
        """Until the pipeline ends, or is silent."""
        self._is_running.clear()
        tasks = [asyncio.create_task(self._forward(channel)) for channel in (*_LIVENESS, *_PERMANENT, *_FOR_VIEWERS)]
        try:
            done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                self.dashboard.take(task.result(), monotonic())
            # It ended: the last health, with what the trees have become, and the last picture may still come.
            await asyncio.wait(rest, timeout=_DRAIN_SECONDS)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _forward(self, channel: str) -> End | None:
        """Until the pipeline ends; what is for viewers only while there are any.

        What says nothing of which pipeline it is from is taken once one is seen: until then, it may be the last message
        of the pipeline before, at the same endpoint.
        """
        timeout = SILENCE_SECONDS if channel == "health" else None
        while True:
            if channel not in _LIVENESS:
                await self._is_running.wait()
            if channel in _FOR_VIEWERS:
                await self._has_viewers.wait()
            with subscribe(self.attached_endpoint, channel, timeout=timeout, keys=self.keys) as messages:  # type: ignore[call-overload]
                async for message in messages:
                    self.dashboard.take(message, monotonic())
                    if self.dashboard.phase == "running":
                        self._is_running.set()
                    if channel in _FOR_VIEWERS and not self.viewers:
                        break
                else:
                    end: End | None = messages.end
                    return end
