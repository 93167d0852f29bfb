"""The web application of a pipeline: its page, pictures and metrics.

/                 the page
/events           updates of the page as server-sent events, at most ten per second
/metrics          metrics for Prometheus
/healthz          200 while this server runs
/readyz           200 while the pipeline tracks; 503 with the reason otherwise
/pictures/T.jpg   the picture of the frame at time T
/picture.jpg      the newest picture with its tracks drawn in
/live.mjpeg       the newest pictures with their tracks drawn in, as an MJPEG stream
/control          POST a command: the fields of `Command`
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Any, Literal, TypeVar

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from catstream.base.box import Box
from catstream.errors import BoxError, CatstreamError, CommandRejectedError, ObjectError, ProtocolError, SilenceError
from catstream.video.drawing import draw_preview
from catstream.web import prometheus
from catstream.web.feed import PipelineFeed
from catstream.wire.codec import decode_json

_Kind = TypeVar("_Kind")

PAGE = Path(__file__).with_name("page")

UPDATE_SECONDS = 0.1  #: interval between two updates
COMMENT_SECONDS = 5.0  #: time without an update after which a comment is sent, to detect closed connections
RETRY_SECONDS = 1.0  #: delay before a page reconnects
_MAX_BODY = 4096  # bytes
_MJPEG = "multipart/x-mixed-replace; boundary=picture"

#: Status codes of errors; the first matching class applies.
_CODES = {
    CommandRejectedError: 409,
    ProtocolError: 400,
    BoxError: 400,
    ObjectError: 400,
    SilenceError: 504,
    CatstreamError: 503,
}


class Site:
    """The web application of a pipeline, `app`, without access control; `Server` serves it."""

    def __init__(self, feed: PipelineFeed) -> None:
        self.feed = feed
        self._closed = False
        routes = [
            Route("/", lambda _: FileResponse(PAGE / "index.html")),
            Route("/events", lambda request: endless(request, self._updates(), "text/event-stream")),
            Route("/metrics", self._metrics),
            Route("/healthz", lambda _: PlainTextResponse("ok\n")),
            Route("/readyz", self._readyz),
            Mount("/page", StaticFiles(directory=PAGE)),
            Route("/pictures/{time:float}.jpg", self._picture),
            Route("/picture.jpg", self._newest_picture),
            Route("/live.mjpeg", lambda request: endless(request, self._annotated_pictures(), _MJPEG)),
            Route("/control", self._control, methods=["POST"]),
        ]
        handlers = {CatstreamError: failed}
        self.app = Starlette(lifespan=self._lifespan, routes=routes, exception_handlers=handlers)

    def close(self) -> None:
        """End the streams of all open pages; called before the shutdown of a server, which waits for them."""
        self._closed = True

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self.feed.start()
        yield
        await asyncio.to_thread(self.feed.stop)

    async def _metrics(self, _: Request) -> Response:
        return prometheus.response(prometheus.of_pipeline(self.feed), self.feed.latency.histogram)

    async def _readyz(self, _: Request) -> Response:
        problem = self.feed.problem
        return PlainTextResponse(f"{problem or 'running'}\n", 503 if problem else 200)

    async def _picture(self, request: Request) -> Response:
        preview = self.feed.dashboard.picture(request.path_params["time"])
        if preview is None:
            return PlainTextResponse("this picture is no longer available\n", 404)
        return Response(preview.jpeg, media_type="image/jpeg")

    async def _newest_picture(self, _: Request) -> Response:
        self.feed.pictured = monotonic()
        if (newest := self.feed.dashboard.newest) is None:
            return PlainTextResponse("no picture has arrived yet\n", 404)
        jpeg = await run_in_threadpool(draw_preview, *newest, self.feed.dashboard.colours)
        return Response(jpeg, media_type="image/jpeg")

    async def _control(self, request: Request) -> Response:
        command = await json_of(request, Command)
        try:
            answer = await run_in_threadpool(self.feed.execute, **asdict(command))
        except asyncio.CancelledError:  # by the server, after the timeout of its shutdown
            raise HTTPException(503, "the server of this page has ended\n") from None
        result = {"reason": answer.reason, "frame": answer.frame, "version": answer.version, "object": answer.object}
        return JSONResponse({"done": True} | result)

    async def _updates(self) -> AsyncIterator[str]:
        """Yield the parts of a page that have changed, as server-sent events."""
        sent: dict[str, Any] = {}
        last_sent = monotonic()
        with self.feed.viewed():
            yield f"retry: {1000 * RETRY_SECONDS:.0f}\n\n"
            while not self._closed:
                if parts := self.feed.dashboard.updates(sent):
                    last_sent = monotonic()
                    yield event(parts)
                elif monotonic() - last_sent > COMMENT_SECONDS:
                    last_sent = monotonic()
                    yield ":\n\n"
                await asyncio.sleep(UPDATE_SECONDS)
            yield event({**self.feed.dashboard.updates(sent), "closed": True})

    async def _annotated_pictures(self) -> AsyncIterator[bytes]:
        last, dashboard = None, self.feed.dashboard
        with self.feed.viewed():
            yield b"--picture\r\n"
            while not self._closed:
                newest = dashboard.newest
                if newest is not None and newest != last:
                    last = newest
                    jpeg = await run_in_threadpool(draw_preview, *newest, dashboard.colours)
                    # Send the next boundary with the picture, because many clients show a picture only after it.
                    header = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
                    yield header + jpeg + b"\r\n--picture\r\n"
                await asyncio.sleep(UPDATE_SECONDS)


async def json_of(request: Request, kind: type[_Kind]) -> _Kind:
    """Decode the body of a request; ProtocolError if it is too long or invalid."""
    # A page of another origin cannot send this content type without a CORS preflight request.
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise HTTPException(415, "expected application/json\n")
    body = b""
    async for part in request.stream():
        if len(body := body + part) > _MAX_BODY:
            raise ProtocolError(f"expected at most {_MAX_BODY} bytes, got more")
    return decode_json(body, kind)


def endless(request: Request, parts: AsyncIterator[str] | AsyncIterator[bytes], media_type: str) -> Response:
    """Return a streaming response; the response to a HEAD request has no parts."""
    return StreamingResponse(iter(()) if request.method == "HEAD" else parts, media_type=media_type)


def event(parts: dict[str, object]) -> str:
    return f"data: {json.dumps(parts, separators=(',', ':'))}\n\n"


@dataclass(frozen=True, slots=True)
class Command:
    """A command from the page: the fields of `catstream.wire.messages.Command` that it may set."""

    verb: Literal["set-box", "forget", "pause", "resume", "stop"]
    object: str = ""
    box: Box | None = None
    keep: bool = False
    seconds: float | None = None
    time: float | None = None


def failed(_: Request, error: Exception) -> Response:
    code = next(code for kind, code in _CODES.items() if isinstance(error, kind))
    return JSONResponse({"done": False, "reason": str(error)}, code)
