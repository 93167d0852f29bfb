"""The web application of a fleet: a wall of pictures, and a page for each stream.

/                       the page
/status                 all streams and nodes as JSON, which the page requests every second
/metrics                metrics for Prometheus
/healthz                200 while this server runs
/readyz                 200 while the fleet answers; 503 with the reason otherwise
/streams/NAME/          the page of a stream, see `catstream.web.app`
/streams/NAME/readyz    200 while the stream tracks; 503 with the reason otherwise
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, replace
from time import monotonic
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import Receive, Scope, Send

from catstream.client.address import Address
from catstream.client.registry import Registry, described
from catstream.errors import CatstreamError
from catstream.web import prometheus
from catstream.web.app import PAGE, Site
from catstream.web.feed import PipelineFeed
from catstream.wire.messages import FleetStatus, NodeStatus, StreamStatus

PERIOD_SECONDS = 1.0  #: interval between two requests to the registry
REGISTRY_SECONDS = 2.0  #: timeout for its answer
IDLE_SECONDS = 60.0  #: time without a request after which the site of a stream is closed

_MAX_SITES = 32  # maximum number of open sites of streams: each has a thread
_HIDDEN = ("endpoint", "server", "token")  # fields of a stream with its address and key

_log = logging.getLogger(__name__)


class Wall:
    """The web application of a fleet, `app`, without access control; `Server` serves it.

    The address is of a fleet without a stream; the fleet may start later. While it does not answer, the last status is
    shown.
    """

    def __init__(self, address: Address) -> None:
        self._address = address
        self._registry: Registry | None = None
        self._status = FleetStatus("", 0.0)
        self._answered = 0.0  # time of the last answer
        self._problem = ""  # reason why the fleet does not answer, empty if it does
        self._sites: dict[str, Site] = {}  # of streams whose page was requested
        self._used: dict[str, float] = {}  # time of the last request to each site
        self._closing = asyncio.Event()
        routes = [
            Route("/", lambda _: FileResponse(PAGE / "fleet.html")),
            Route("/status", self._all),
            Route("/metrics", self._metrics),
            Route("/healthz", lambda _: PlainTextResponse("ok\n")),
            Route("/readyz", self._readyz),
            Route("/streams/{stream}/readyz", self._readyz),
            Mount("/streams/{stream}", self._stream),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        self.app = Starlette(lifespan=self._lifespan, routes=routes)

    def close(self) -> None:
        """End the streams of all open pages; called before the shutdown of a server, which waits for them."""
        self._closing.set()
        for site in self._sites.values():
            site.close()

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        await asyncio.to_thread(self._ask)  # before the first request, which may be for a stream
        asking = asyncio.create_task(self._keep_asking())
        yield
        await asking
        for site in self._sites.values():
            site.feed.end()
        if self._registry is not None:
            self._registry.close()

    async def _keep_asking(self) -> None:
        while not self._closing.is_set():
            await asyncio.to_thread(self._ask)
            self._close_unused(IDLE_SECONDS)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._closing.wait(), PERIOD_SECONDS)

    def _ask(self) -> None:
        """Request all streams and nodes from the registry."""
        try:
            if self._registry is None:
                self._registry = self._address.registry
                self._registry.timeout = REGISTRY_SECONDS
            self._status = self._registry.streams()
            self._answered, self._problem = monotonic(), ""
        except CatstreamError as error:
            self._problem = str(error)
        except Exception as error:  # an unexpected error must not end the task silently
            _log.exception("The page lost the state of the fleet, and tries again.")
            self._problem = f"{type(error).__name__}: {error}"

    def _find(self, stream: str) -> StreamStatus:
        if stream not in self._status.streams:
            raise HTTPException(404, f"this fleet has no stream {stream!r}\n")
        return self._status.streams[stream]

    def site(self, stream: str) -> Site:
        """The site of a stream, opened by the first request for its page."""
        self._find(stream)
        if stream not in self._sites:
            if len(self._sites) >= _MAX_SITES:
                self._close_unused(0.0)
            if len(self._sites) >= _MAX_SITES:
                raise HTTPException(503, "too many pages of streams are open already\n")
            self._sites[stream] = Site(PipelineFeed(replace(self._address, stream=stream)))
            self._sites[stream].feed.start()
        self._used[stream] = monotonic()
        return self._sites[stream]

    def _close_unused(self, seconds: float) -> None:
        """Close the sites without open pages that had no request for `seconds`."""
        for stream, site in list(self._sites.items()):
            if not site.feed.viewers and monotonic() - self._used[stream] >= seconds:
                self._sites.pop(stream).feed.end()

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.site(scope["path_params"]["stream"]).app(scope, receive, send)

    async def _all(self, _: Request) -> Response:
        age = monotonic() - self._answered if self._problem else 0.0
        return JSONResponse(
            {
                "name": self._status.name,
                "problem": self._problem,
                "age": int(age) if self._answered else None,
                "streams": list(map(_shown, self._status.streams.values())),
                "nodes": list(map(_shown, self._status.nodes.values())),
            }
        )

    async def _metrics(self, _: Request) -> Response:
        return prometheus.response(prometheus.of_fleet(None if self._problem else self._status))

    async def _readyz(self, request: Request) -> Response:
        """Readiness of the fleet or of a stream. It needs no token, so it must not reveal an address."""
        problem = "the fleet does not answer" if self._problem else ""
        if not problem and (stream := request.path_params.get("stream")):
            status = self._find(stream)
            problem = "" if status.state == "running" else described(status)
        return PlainTextResponse(f"{problem or 'running'}\n", 503 if problem else 200)


def _shown(status: StreamStatus | NodeStatus) -> dict[str, Any]:
    """The fields of a stream or a node for the page, without the address and the key of a pipeline."""
    return {name: value for name, value in asdict(status).items() if name not in _HIDDEN}
