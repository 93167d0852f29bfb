"""The web application of a fleet: one page for all streams, and below it the page of each stream.

/                           the page of the fleet
/events                     updates of this page as server-sent events
/streams/NAME/              the page of a stream, with all paths of `catstream.web.app`
/streams/NAME/picture.jpg   a small picture of its newest frame; 204 if there is none
/metrics                    metrics of all streams and nodes for Prometheus
/healthz                    200 while this server runs
/readyz                     200 while the fleet answers
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from catstream.errors import CatstreamError
from catstream.web import fleet_metrics
from catstream.web.fleet_feed import FleetFeed
from catstream.web.fleet_pictures import Pictures
from catstream.web.fleet_streams import StreamPages
from catstream.web.server import Site

__all__ = ["fleet_site"]

_PAGE = Path(__file__).with_name("page")


class _Pages:
    """The handlers of the routes."""

    def __init__(self, feed: FleetFeed, streams: StreamPages, pictures: Pictures) -> None:
        self._feed, self._streams, self._pictures = feed, streams, pictures

    async def index(self, _: Request) -> Response:
        return FileResponse(_PAGE / "fleet.html")

    async def events(self, _: Request) -> Response:
        return self._feed.viewers.events(self._feed.dashboard.updates)

    async def picture(self, request: Request) -> Response:
        name = request.path_params["name"]
        if (stream := self._feed.stream(name)) is None:
            return _unknown(name)
        try:
            jpeg = await self._pictures.get(stream)
        except CatstreamError as error:
            return PlainTextResponse(f"{error}\n", 503)
        return Response(status_code=204) if jpeg is None else Response(jpeg, media_type="image/jpeg")

    async def stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on to the page of a stream."""
        name = scope["path_params"]["name"]
        app: ASGIApp
        if self._feed.stream(name) is None:
            app = _unknown(name)
        else:
            app = self._streams.open(name) or PlainTextResponse("too many pages of streams are open already\n", 503)
        await app(scope, receive, send)

    async def metrics(self, _: Request) -> Response:
        return Response(fleet_metrics.text(self._feed), media_type="text/plain; version=0.0.4; charset=utf-8")

    async def healthz(self, _: Request) -> Response:
        return PlainTextResponse("ok\n")

    async def readyz(self, _: Request) -> Response:
        if self._feed.dashboard.phase == "running":
            return PlainTextResponse("ok\n")
        return PlainTextResponse("the fleet does not answer\n", 503)  # the reason has its address, and needs the token


def _unknown(name: str) -> Response:
    return PlainTextResponse(f"this fleet has no stream {name!r}\n", 404)


def fleet_site(fleet: str = "", keys: str = "") -> Site:
    """Return the site of a fleet, which may start later; the arguments are those of `FleetFeed`."""
    feed = FleetFeed(fleet, keys)
    streams = StreamPages(feed.feed_of)
    pages = _Pages(feed, streams, Pictures(feed.endpoint_of))

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        async with feed.running():
            yield
        await streams.stop()

    app = Starlette(
        lifespan=lifespan,
        routes=[
            Route("/", pages.index),
            Route("/events", pages.events),
            Route("/streams/{name}/picture.jpg", pages.picture),
            Mount("/streams/{name}", pages.stream),
            Route("/metrics", pages.metrics),
            Route("/healthz", pages.healthz),
            Route("/readyz", pages.readyz),
            Mount("/page", StaticFiles(directory=_PAGE)),
        ],
    )

    def close() -> None:
        feed.viewers.close()
        streams.close_viewers()

    return Site(app, close)
