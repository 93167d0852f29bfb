"""A tracker for CVAT: a function of Nuclio that follows the rectangles of an annotator from frame to frame.

    make wheel && cp dist/catstream-*.whl examples/cvat_function
    nuctl deploy --project-name cvat --path examples/cvat_function --platform local

CVAT sends a picture with the shapes to begin with, or with the states from the frame before, and gets the shapes of
this picture and the states for the next. A shape is [left, top, right, bottom] in pixels, and null if the object is
absent. A tracker stays in this process; the state has its name, the number of its last frame, and the last shape. If
the process no longer has it, or it is in another frame because the annotator went back, a new one begins at that shape.
"""

from __future__ import annotations

import base64
import json
from itertools import zip_longest
from typing import Any
from uuid import uuid4

import cv2
import numpy as np

import catstream
from catstream.errors import BoxError, FrameError

MOST = 100  # trackers that are kept
Shape = list[float]  # left, top, right, bottom
State = dict[str, Any]  # tracker, frame, shape


def init_context(context: Any) -> None:
    """Compile the kernels before the first request; Nuclio calls this once."""
    catstream.Tracker()
    context.user_data.trackers = {}


def handler(context: Any, event: Any) -> Any:
    """Answer a request of CVAT."""
    shapes, states = event.body.get("shapes", []), event.body.get("states", [])
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(event.body["image"]), np.uint8), cv2.IMREAD_COLOR)
    trackers: dict[str, catstream.Tracker] = context.user_data.trackers
    try:
        if picture is None:
            raise FrameError("expected a picture as PNG or JPEG, in base64")
        found = [
            follow(trackers, picture, state) if state else (shape, begin(trackers, picture, shape))
            for shape, state in zip_longest(shapes, states)
        ]
    except (BoxError, FrameError) as error:
        return context.Response(body=str(error), content_type="text/plain", status_code=400)
    while len(trackers) > MOST:
        del trackers[next(iter(trackers))]  # the one that was not used for the longest time
    body = json.dumps({"shapes": [shape for shape, _ in found], "states": [state for _, state in found]})
    return context.Response(body=body, content_type="application/json", status_code=200)


def begin(trackers: dict[str, catstream.Tracker], picture: np.ndarray, shape: Shape) -> State:
    """Begin a tracker at a shape, and return its state."""
    left, top, right, bottom = shape
    tracker = catstream.Tracker()
    tracker.init(picture, (left, top, right - left, bottom - top))
    trackers[name := uuid4().hex] = tracker
    return {"tracker": name, "frame": 0, "shape": shape}


def follow(trackers: dict[str, catstream.Tracker], picture: np.ndarray, state: State) -> tuple[Shape | None, State]:
    """Find an object in the next picture, and return its shape and state."""
    tracker = trackers.pop(state["tracker"], None)
    if tracker is None or tracker.track.frame != state["frame"]:
        return state["shape"], begin(trackers, picture, state["shape"])
    trackers[state["tracker"]] = tracker  # now the last
    _, box = tracker.update(picture)
    shape = None if box is None else [box.x, box.y, box.x + box.w, box.y + box.h]
    return shape, {**state, "frame": tracker.track.frame, "shape": shape or state["shape"]}
