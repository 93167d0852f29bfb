"""The web application of one pipeline: the page, its events and pictures, control, and metrics.

/                 the page
/events           updates of the page as server-sent events, at most ten per second
/pictures/N.jpg   the picture of frame N
/live.mjpeg       the newest pictures with their tracks drawn in, as an MJPEG stream
/control          POST {"verb": ..., "object": ..., "box": [x, y, w, h], "keep": ...}
/metrics          metrics for Prometheus
/healthz          200 while this server runs
/readyz           200 while all processes of the pipeline send health reports
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import Lifespan

from catstream.errors import CatstreamError, CommandRejectedError, ProtocolError, SilenceError
from catstream.messages.kinds import Answer
from catstream.messages.names import check_name
from catstream.video.annotate import draw_preview
from catstream.web import metrics
from catstream.web.feed import Feed
from catstream.web.guard import TokenBucket, body_of, too_many
from catstream.web.server import Site
from catstream.web.viewers import UPDATE_SECONDS
from catstream.wire.channels import CHANNELS

__all__ = ["pipeline_app", "pipeline_site"]

_PAGE = Path(__file__).with_name("page")
_COMMANDS, _COMMANDS_PER_SECOND = 20, 5
_VERBS = ("set-box", "forget", "pause", "resume", "stop")
_DEFAULTS: dict[str, object] = {"verb": "", "object": "", "box": None, "keep": False}  # of the fields of a command


def pipeline_site(endpoint: str = "", keys: str = "") -> Site:
    """Return the site of the pipeline at an endpoint, as in `Feed`."""
    feed = Feed(endpoint, keys)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        async with feed.running():
            yield

    return Site(pipeline_app(feed, lifespan), feed.viewers.close)


def pipeline_app(feed: Feed, lifespan: Lifespan[Starlette] | None = None) -> Starlette:
    """Return the application of the page that a feed keeps up to date; its URLs are relative, so it can be mounted."""
    pages = _Pages(feed)
    return Starlette(
        lifespan=lifespan,
        routes=[
            Route("/", pages.index),
            Route("/events", pages.events),
            Route("/live.mjpeg", pages.live),
            Route("/pictures/{frame:int}.jpg", pages.picture),
            Route("/control", pages.control, methods=["POST"]),
            Route("/metrics", pages.metrics),
            Route("/healthz", pages.healthz),
            Route("/readyz", pages.readyz),
            Mount("/page", StaticFiles(directory=_PAGE)),
        ],
    )


class _Pages:
    """The handlers of the routes."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._commands = TokenBucket(_COMMANDS, _COMMANDS_PER_SECOND)

    async def index(self, _: Request) -> Response:
        return FileResponse(_PAGE / "index.html")

    async def events(self, _: Request) -> Response:
        return self._feed.viewers.events(self._feed.dashboard.updates)

    async def live(self, _: Request) -> Response:
        return self._feed.viewers.too_many() or StreamingResponse(
            self._annotated_stream(), media_type="multipart/x-mixed-replace; boundary=picture"
        )

    async def _annotated_stream(self) -> AsyncIterator[bytes]:
        shown = None
        with self._feed.viewers.counted():
            yield b"--picture\r\n"
            while not self._feed.viewers.closed:
                newest = self._feed.dashboard.newest
                if newest is not None and newest != shown:
                    shown = newest
                    jpeg = await run_in_threadpool(draw_preview, *newest, self._feed.dashboard.objects.colours)
                    # The boundary after the picture is sent with it: many clients show a picture only after it.
                    yield b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n--picture\r\n" % (
                        len(jpeg),
                        jpeg,
                    )
                await asyncio.sleep(UPDATE_SECONDS)

    async def picture(self, request: Request) -> Response:
        preview = self._feed.dashboard.picture(request.path_params["frame"])
        if preview is None:
            return PlainTextResponse("this picture is no longer available\n", 404)
        return Response(preview.jpeg, media_type="image/jpeg")

    async def control(self, request: Request) -> Response:
        # A page of another origin cannot send this content type without a CORS preflight request.
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return _refused(415, "expected application/json")
        if wait := self._commands.wait(monotonic()):
            return too_many(wait)
        self._commands.take()
        try:
            command = _command(await body_of(request))
        except ValueError as error:
            return _refused(400, str(error))
        try:
            answer = await run_in_threadpool(_execute, self._feed, command)
        except CommandRejectedError as error:
            return _refused(409, str(error))
        except ProtocolError as error:
            return _refused(400, str(error))
        except SilenceError as error:
            return _refused(504, str(error))
        except CatstreamError as error:
            return _refused(503, str(error))
        result = {"reason": answer.reason, "frame": answer.frame, "version": answer.version, "object": answer.object}
        return JSONResponse({"done": True} | result)

    async def metrics(self, _: Request) -> Response:
        return Response(metrics.text(self._feed), media_type="text/plain; version=0.0.4; charset=utf-8")

    async def healthz(self, _: Request) -> Response:
        return PlainTextResponse("ok\n")

    async def readyz(self, _: Request) -> Response:
        silent = [name for name in CHANNELS["health"].senders if name not in self._feed.dashboard.last_reports]
        return (
            PlainTextResponse(f"no health report from: {', '.join(silent)}\n", 503)
            if silent
            else PlainTextResponse("ok\n")
        )


@dataclass(frozen=True, slots=True)
class _Command:
    """A posted command: verb, name of the object, and the arguments of `Control.set_box`."""

    verb: str
    object: str
    box: list[float] | None
    keep: bool


def _command(body: bytes | None) -> _Command:
    """Return a posted command. Raises ValueError if it is not valid."""
    if body is None:
        raise ValueError("expected a command, got more than 4096 bytes")
    try:
        # An integer that is too large becomes infinite, and is rejected.
        command: object = json.loads(body, parse_int=float)
    except (RecursionError, ValueError) as error:
        raise ValueError(f"expected a command in JSON: {error}") from None
    if not isinstance(command, dict) or command.get("verb") not in _VERBS:
        raise ValueError(f'expected "verb": one of {", ".join(_VERBS)}')
    verb, name, box, keep = (command.get(key, default) for key, default in _DEFAULTS.items())
    numbers = isinstance(box, list) and len(box) == 4 and all(type(side) is float for side in box)
    if (verb == "set-box") != numbers or not isinstance(keep, bool) or (box is not None and not numbers):
        raise ValueError('expected "box": [x, y, w, h] with set-box and with nothing else, and "keep": true or false')
    if not isinstance(name, str) or (name and verb not in ("set-box", "forget")):
        raise ValueError('expected "object": the name of an object, with set-box and forget and with nothing else')
    return _Command(verb, check_name(name), box, keep)


def _execute(feed: Feed, command: _Command) -> Answer:
    """Send a command and wait for its answer."""
    with feed.control() as pipeline:
        if command.box is not None:
            return pipeline.set_box(command.box, object=command.object, keep=command.keep)
        if command.verb == "forget":
            return pipeline.forget(command.object)
        return {"pause": pipeline.pause, "resume": pipeline.resume, "stop": pipeline.stop}[command.verb]()


def _refused(code: int, reason: str) -> Response:
    return JSONResponse({"done": False, "reason": reason}, code)
