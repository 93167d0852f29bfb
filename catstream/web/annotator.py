"""The web application of `catstream annotate`: a page that shows the session of a video, and changes its boxes.

/                the page
/events          the state of the session and its changes, as server-sent events, at most ten per second
/frames/N.jpg    the picture of a frame, scaled down if it is large; /frames/N.jpg?full has all pixels
/frames/N        its size, and the boxes and proposals of the objects in it; both have ?video=N, by default 0
/edit            POST a change: the fields of `Edit`
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from secrets import token_hex
from typing import Literal

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from catstream.base.arrays import Bool
from catstream.base.box import Box
from catstream.base.names import check_name
from catstream.errors import CatstreamError, CommandRejectedError
from catstream.offline.keyframes import HIDDEN, KeyframeBox
from catstream.offline.session import Session, Sessions
from catstream.video.drawing import PALETTE
from catstream.video.frames import describe_counters, jpeg
from catstream.web.app import PAGE, UPDATE_SECONDS, endless, event, failed, json_of

_PARTS = 2000  #: maximum number of parts of a timeline, about its width in pixels
_SIDE = 1920  #: longest side of a picture in pixels, to which larger frames are scaled down


class AnnotationSite:
    """The web application of the open session, `app`, without access control; `Server` serves it."""

    def __init__(self, sessions: Sessions) -> None:
        self._sessions, self._closed = sessions, False
        self._id = token_hex(8)  # distinguishes this server from an earlier one at the same port
        routes = [
            Route("/", lambda _: FileResponse(PAGE / "annotate.html")),
            Route("/events", lambda request: endless(request, self._states(), "text/event-stream")),
            Route("/frames/{number:int}.jpg", self._picture),
            Route("/frames/{number:int}", self._frame),
            Route("/edit", self._edit, methods=["POST"]),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        self.app = Starlette(routes=routes, exception_handlers={CatstreamError: failed})

    @property
    def _session(self) -> Session:
        return self._sessions.current

    def close(self) -> None:
        """End the events of all open pages; called before the shutdown of a server, which waits for them."""
        self._closed = True

    def _picture(self, request: Request) -> Response:
        image, is_full = self._session.image(self._number(request)), "full" in request.query_params
        return Response(jpeg(image, None if is_full else _SIDE, 95 if is_full else 90), media_type="image/jpeg")

    def _frame(self, request: Request) -> Response:
        """The size of a frame, the box of each object in it, and the proposals if the box is unchecked."""
        number, session = self._number(request), self._session
        objects = {}
        with session.lock:
            for name, drawn in session.annotation.keyframes.items():
                track = session.tracks[name][number] if name in session.tracks else None
                box = track.box if track else None
                answer = drawn.get(number, box)
                check = track.checked if track else "unchecked"
                proposals = session.annotation.proposals(name, number) if session.decoded else {}
                objects[name] = {
                    "box": _rounded(box if answer == HIDDEN else answer),
                    "checked": HIDDEN if answer == HIDDEN else "keyframe" if number in drawn else check,
                    "proposals": [[_rounded(proposals[way])] if way in proposals else None for way in (True, False)],
                }
        return JSONResponse({"size": session.annotation.frames.size, "objects": objects})

    def _number(self, request: Request) -> int:
        number: int = request.path_params["number"]
        if request.query_params.get("video", "0") != str(self._sessions.number):
            raise HTTPException(404, "another video is open\n")
        if number >= len(self._session.annotation.frames):
            raise HTTPException(404, f"frame {number} is not in the video, or not read yet\n")
        return number

    async def _edit(self, request: Request) -> Response:
        edit = await json_of(request, Edit)
        if edit.server != self._id:
            raise CommandRejectedError("this page belongs to an earlier command: reload it")
        more = await run_in_threadpool(self._change, edit)
        return JSONResponse({"done": True, "revision": self._session.revision, **more})

    def _change(self, edit: Edit) -> dict[str, object]:
        if edit.verb == "open" and 0 <= edit.video < len(self._sessions.names):
            self._sessions.open(edit.video)
        elif edit.video != self._sessions.number:
            raise CommandRejectedError("another video is open")
        elif edit.verb == "undo":
            return dict(zip(("object", "frame"), self._session.undo() or (), strict=False))
        elif edit.verb == "rename":
            self._session.rename(edit.object, edit.name)
        elif edit.verb == "delete":
            self._session.delete(edit.object, edit.frame)
        elif edit.verb == "done":
            self._session.finish()
        else:
            box: KeyframeBox = HIDDEN if isinstance(edit.box, str) else edit.box and Box(*edit.box)
            self._session.draw(check_name(edit.object), edit.frame or 0, box)
        return {}

    async def _states(self) -> AsyncIterator[str]:
        """Yield the state, and then changed values, as server-sent events."""
        shown: dict[str, object] = {}
        while not self._closed:
            state = await run_in_threadpool(self._state)
            if changed := {key: value for key, value in state.items() if key not in shown or shown[key] != value}:
                yield event(changed)
            shown = state
            await asyncio.sleep(UPDATE_SECONDS)
        yield event({"closed": True})

    def _state(self) -> dict[str, object]:
        number = self._sessions.number
        session = self._sessions.opened[number]
        with session.lock:
            return {
                "server": self._id,
                "video": number,
                "videos": [*zip(self._sessions.names, self._sessions.shares, strict=True)],
                "frames": len(session.annotation.frames),
                "decoded": session.decoded,
                "objects": _described(session),
                "next": [*session.next_frames[:99]],
                "remaining": session.remaining(),
                "revision": session.revision,
                "undo": session.can_undo,
                "problem": str(session.problem or ", ".join(describe_counters(session.annotation.frames.counters))),
            }


@dataclass(frozen=True, slots=True)
class Edit:
    """A change by the page.

    server  id of the server, from the state of the page
    video   number of the open video, or of the video for "open"
    verb    "draw" a box at a frame; "delete" it; "undo" the last change; "rename" an object; "open" a video; "done"
    object  name of the object
    frame   number of the frame; None deletes the object
    box     x, y, w, h in pixels; "hidden"; or None if the object is absent
    name    new name
    """

    server: str
    verb: Literal["draw", "delete", "undo", "rename", "open", "done"]
    video: int = 0
    object: str = ""
    frame: int | None = None
    box: tuple[float, float, float, float] | Literal["hidden"] | None = None
    name: str = ""


def _described(session: Session) -> list[dict[str, object]]:
    """The objects with their keyframes, and the number and ranges of unchecked frames."""
    objects: list[dict[str, object]] = []
    for name, drawn in session.annotation.keyframes.items():
        unchecked = np.ones(len(session.annotation.frames), bool)
        if name in session.tracks:
            unchecked = session.tracks[name].unchecked
        objects.append(
            {
                "name": name,
                "colour": PALETTE[len(objects) % len(PALETTE)],
                "keyframes": sorted(drawn),
                "wrong": int(unchecked.sum()),
                "unchecked": _runs(unchecked),
            }
        )
    return objects


def _rounded(box: Box | None) -> list[float] | None:
    return box and [round(side, 1) for side in box]


def _runs(mask: Bool) -> list[tuple[int, int]]:
    """The first and the last frame of each run of True, rounded to parts of the timeline in a long video."""
    part = -(-len(mask) // _PARTS) or 1
    parts = np.pad(mask, (0, -len(mask) % part)).reshape(-1, part).any(axis=1)
    edges = np.flatnonzero(np.diff(np.pad(parts, 1)))
    return [(part * int(start), min(part * int(stop), len(mask)) - 1) for start, stop in edges.reshape(-1, 2)]
