"""The web application: the page of a pipeline, or the page of a fleet and below it that of each of its streams.

/                 the page
/events           updates of the page as server-sent events, at most ten per second
/metrics          metrics for Prometheus
/healthz          200 while this server runs
/readyz           200 while the pipeline tracks, or the fleet answers; 503 with the reason otherwise
/pictures/T.jpg   the picture of a pipeline of the frame at time T
/picture.jpg      the newest picture of a pipeline with its tracks drawn in
/live.mjpeg       the newest pictures of a pipeline with their tracks drawn in, as an MJPEG stream
/control          POST a command to a pipeline: the fields of `Command`
/streams/NAME/    all of the above for the pipeline of a stream of a fleet
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Literal, TypeVar

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.errors import BoxError, CatstreamError, CommandRejectedError, ObjectError, ProtocolError, SilenceError
from catstream.video.drawing import draw_preview
from catstream.web import prometheus
from catstream.web.feed import REGISTRY_SECONDS, Feed, FleetFeed, PipelineFeed
from catstream.wire.codec import decode_json

_Kind = TypeVar("_Kind")

PAGE = Path(__file__).with_name("page")

UPDATE_SECONDS = 0.1  #: between two updates
COMMENT_SECONDS = 5.0  #: without an update, after which a comment is sent, which detects closed connections
RETRY_SECONDS = 1.0  #: after which a page whose connection broke connects again
_MAX_BODY = 4096  # bytes

#: Status code of the answer to a request that ends with an error: that of its first class here.
_CODES = {
    CommandRejectedError: 409,
    ProtocolError: 400,
    BoxError: 400,
    ObjectError: 400,
    SilenceError: 504,
    CatstreamError: 503,
}


def pipeline_site(address: Address) -> Site:
    """The site of a pipeline, which may start later."""
    return Site(PipelineFeed(address))


def fleet_site(address: Address) -> Site:
    """The site of a fleet, which may start later; the address names no stream."""
    return Site(FleetFeed(address))


class Site:
    """The web application of a pipeline or of a fleet, `app`, without access control; `Server` serves it."""

    def __init__(self, feed: PipelineFeed | FleetFeed) -> None:
        self._feed = feed
        self._closed = False
        common = [
            Route("/", self._index),
            Route("/events", self._events),
            Route("/metrics", self._metrics),
            Route("/healthz", self._healthz),
            Route("/readyz", self._readyz),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        routes = [
            *common,
            Route("/pictures/{time:float}.jpg", self._picture),
            Route("/picture.jpg", self._newest_picture),
            Route("/live.mjpeg", self._live),
            Route("/control", self._control, methods=["POST"]),
        ]
        if isinstance(feed, FleetFeed):
            routes = [*common, Mount("/streams/{stream}", routes=routes)]
        handlers = {CatstreamError: failed}
        self.app = Starlette(lifespan=self._lifespan, routes=routes, exception_handlers=handlers)

    def close(self) -> None:
        """End the streams of all open pages; called before the shutdown of a server, which waits for them."""
        self._closed = True

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self._feed.start()
        if isinstance(self._feed, FleetFeed):  # the first requests wait, so that each stream is known
            await asyncio.to_thread(self._feed.has_asked.wait, REGISTRY_SECONDS)
        yield
        await asyncio.to_thread(self._feed.stop)

    async def _index(self, request: Request) -> Response:
        self._feed_of(request)
        return FileResponse(PAGE / "index.html")

    async def _events(self, request: Request) -> Response:
        return endless(request, self._updates(self._feed_of(request)), "text/event-stream")

    async def _metrics(self, request: Request) -> Response:
        text = prometheus.text(self._feed_of(request))
        return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")

    async def _healthz(self, _: Request) -> Response:
        return PlainTextResponse("ok\n")

    async def _readyz(self, request: Request) -> Response:
        problem = self._feed.problem_of(request.path_params.get("stream", ""))
        return PlainTextResponse(f"{problem or 'running'}\n", 503 if problem else 200)

    async def _picture(self, request: Request) -> Response:
        preview = self._pipeline(request).dashboard.picture(request.path_params["time"])
        if preview is None:
            return PlainTextResponse("this picture is no longer available\n", 404)
        return Response(preview.jpeg, media_type="image/jpeg")

    async def _newest_picture(self, request: Request) -> Response:
        feed = self._pipeline(request)
        feed.pictured = monotonic()
        if (newest := feed.dashboard.newest) is None:
            return PlainTextResponse("no picture has arrived yet\n", 404)
        return Response(await run_in_threadpool(draw_preview, *newest, feed.dashboard.colours), media_type="image/jpeg")

    async def _live(self, request: Request) -> Response:
        pictures = self._annotated_pictures(self._pipeline(request))
        return endless(request, pictures, "multipart/x-mixed-replace; boundary=picture")

    async def _control(self, request: Request) -> Response:
        feed = self._pipeline(request)
        command = await json_of(request, Command)
        box = Box(*command.box) if command.box is not None else None
        try:
            answer = await run_in_threadpool(feed.execute, **asdict(command) | {"box": box})
        except asyncio.CancelledError:  # by the server, which waits for its shutdown no longer
            raise HTTPException(503, "the server of this page has ended\n") from None
        result = {"reason": answer.reason, "frame": answer.frame, "version": answer.version, "object": answer.object}
        return JSONResponse({"done": True} | result)

    def _feed_of(self, request: Request) -> Feed:
        """The feed of the page that a request is about."""
        return self._pipeline(request) if "stream" in request.path_params else self._feed

    def _pipeline(self, request: Request) -> PipelineFeed:
        """The feed of the stream that a request names, or of the only one."""
        return self._feed.pipeline(request.path_params.get("stream", ""))

    async def _updates(self, feed: Feed) -> AsyncIterator[str]:
        """Yield the parts of a page that have changed, as server-sent events."""
        revisions: dict[str, int] = {}
        last_sent = monotonic()
        with feed.viewed():
            yield f"retry: {1000 * RETRY_SECONDS:.0f}\n\n"
            while not self._closed:
                if parts := feed.dashboard.updates(revisions):
                    last_sent = monotonic()
                    yield event(parts)
                elif monotonic() - last_sent > COMMENT_SECONDS:
                    last_sent = monotonic()
                    yield ":\n\n"
                await asyncio.sleep(UPDATE_SECONDS)
            yield event({**feed.dashboard.updates(revisions), "closed": True})

    async def _annotated_pictures(self, feed: PipelineFeed) -> AsyncIterator[bytes]:
        last = None
        with feed.viewed():
            yield b"--picture\r\n"
            while not self._closed:
                newest = feed.dashboard.newest
                if newest is not None and newest != last:
                    last = newest
                    jpeg = await run_in_threadpool(draw_preview, *newest, feed.dashboard.colours)
                    # The boundary after the picture is sent with it: many clients show a picture only after it.
                    head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                    yield head + jpeg + b"\r\n--picture\r\n"
                await asyncio.sleep(UPDATE_SECONDS)


async def json_of(request: Request, kind: type[_Kind]) -> _Kind:
    """The message in the body of a request; ProtocolError if it is too long or not valid."""
    # A page of another origin cannot send this content type without a CORS preflight request.
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "expected application/json\n")
    body = b""
    async for part in request.stream():
        if len(body := body + part) > _MAX_BODY:
            raise ProtocolError(f"expected at most {_MAX_BODY} bytes, got more")
    return decode_json(body, kind)


def endless(request: Request, parts: AsyncIterator[str] | AsyncIterator[bytes], media_type: str) -> Response:
    """Return the response to a request, which ends only for a HEAD request: its response has no parts."""
    return StreamingResponse(iter(()) if request.method == "HEAD" else parts, media_type=media_type)


def event(parts: dict[str, object]) -> str:
    return f"data: {json.dumps(parts, separators=(',', ':'))}\n\n"


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the page: the fields of `catstream.messages.kinds.Command` that it may set."""

    verb: Literal["set-box", "forget", "pause", "resume", "stop"]
    object: str = ""
    box: tuple[float, float, float, float] | None = None
    keep: bool = False
    seconds: float | None = None
    time: float | None = None


def failed(_: Request, error: Exception) -> Response:
    code = next(code for kind, code in _CODES.items() if isinstance(error, kind))
    return JSONResponse({"done": False, "reason": str(error)}, code)
