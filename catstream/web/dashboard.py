"""The state of a page: of a pipeline, computed from its messages, and of a fleet. It uses no socket and no clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from itertools import takewhile
from typing import Any, Literal

from catstream.messages.heads import TREES
from catstream.messages.kinds import End, Features, FleetStatus, Health, Model, NodeStatus, Preview, StreamStatus, Track
from catstream.web.objects import Objects
from catstream.web.recent import Recent
from catstream.web.surprising import SurprisingFrames
from catstream.web.timing import POINT_SECONDS, RATE_SECONDS

#: Phase of a pipeline or a fleet: no message yet, running, silent for some seconds, ended.
Phase = Literal["waiting", "running", "silent", "ended"]

#: States in which the pipeline of a stream runs.
RUNNING = ("running", "waiting", "paused")

_POINTS = 480  # two minutes
_FRAMES = 4096  # number of frames whose arrival times are kept, for the latency of models
_TRACKS = 256  # number of frames whose tracks are kept until their picture arrives
_PICTURES = 64  # number of pictures that a page may still request, for slow connections, or whose features may arrive

#: A point of the charts: time, frames per second, and of each object its score, model latency, model version, and
#: whether it is present.
_Point = tuple[float, float, dict[str, tuple[float, float | None, int, bool]]]


class Parts:
    """The state of a page, in parts that are sent to each open page when they have changed.

    Parameters
    ----------
    parts : of each part the function that returns it as JSON values; its argument is the number of changes since the
        page has received it. The parts are sent in this order

    Attributes
    ----------
    phase, reason : phase of the pipeline or the fleet, and the reason of its end or silence
    """

    def __init__(self, parts: Mapping[str, Callable[[int], object]]) -> None:
        self._parts = parts
        self._revisions: Counter[str] = Counter()
        self.phase: Phase = "waiting"
        self.reason = ""
        self._mark_changed(*parts)

    def updates(self, seen: dict[str, int]) -> dict[str, object]:
        """Return the parts that have changed since the last call for this page; all at first.

        Parameters
        ----------
        seen : revisions that the page has received; empty at first, updated by this call
        """
        news = {name: self._revisions[name] - seen.get(name, 0) for name in self._parts}
        seen.update(self._revisions)
        return {name: part(news[name]) for name, part in self._parts.items() if news[name]}

    def mark_silent(self, reason: str, now: float) -> None:  # noqa: ARG002  # a fleet keeps its age
        """Record that nothing arrives, at the time `now` in seconds of a monotonic clock."""
        if self.phase == "running":
            self.phase = "silent"
        if self.phase != "ended":
            self.reason = reason
        self._mark_changed("status")

    def _mark_changed(self, *parts: str) -> None:
        self._revisions.update(parts)


class Dashboard(Parts):
    """Receives messages, and returns the updates for each open page.

    It shows one pipeline. It keeps the last picture and figures until the first message of another pipeline arrives;
    then it drops all state of the previous one.

    endpoint, source : endpoint of the pipeline, and its source of frames
    health : last health report of each process
    last_reports : arrival time of the last health report of each process
    objects : the objects that are tracked
    """

    def __init__(self) -> None:
        super().__init__(
            {
                "pipeline": lambda _: self._revisions["pipeline"],  # the number of pipelines so far; clears a page
                "status": self._status_part,
                "tracks": self._tracks_part,
                "picture": self._picture_part,
                "points": self._points_part,
                "trees": self._trees_part,
                "surprising": self._surprising_part,
            }
        )
        self.endpoint = self._attached = ""
        self._run = ""  # id of the run that is shown
        self._runs_before: set[str] = set()  # ids of those before it, whose last messages may still arrive
        self._reset()

    def _reset(self) -> None:
        """Drop all state of the previous pipeline."""
        self.phase: Phase = "waiting"
        self.reason = self.source = ""
        self.objects = Objects()
        self.health: dict[str, Health] = {}
        self.last_reports: dict[str, float] = {}
        self.pictures = Recent[int, Preview](_PICTURES)
        self.surprising = SurprisingFrames(self.pictures)
        self._points: deque[_Point] = deque(maxlen=_POINTS)
        self._last_point = float("-inf")  # time of the last chart point
        self._arrivals = Recent[int, float](_FRAMES)  # of the first track of each frame
        self._tracks = Recent[int, dict[str, Track]](_TRACKS)  # by frame and object
        self._frame: tuple[int, float] | None = None  # number and time of the newest frame

    def attach(self, endpoint: str) -> None:
        """Expect messages from this endpoint from now on; the state is kept until the first one arrives."""
        self._attached = endpoint
        if self.phase == "waiting":
            self.endpoint = endpoint
            self._mark_changed("status")

    def take(self, message: object, now: float, run: str = "") -> None:
        """Process a message that arrived at the time `now`, in seconds of a monotonic clock.

        Parameters
        ----------
        run : id of the run that it is from; empty if its sender knows none: then it is of the run that is shown
        """
        if run in self._runs_before:
            return
        if run and run != self._run:
            if self._run:
                self._runs_before.add(self._run)
                self._reset()
                self._mark_changed(*self._parts)
            self._run, self.endpoint = run, self._attached
        if self.phase in ("waiting", "silent") and not isinstance(message, End):
            self.phase, self.reason = "running", ""
            self._mark_changed("status")
        match message:
            case Track():
                self._add_track(message, now)
            case Model():
                self._add_model(message, now)
            case Health():
                self._add_health(message, now)
            case Preview():
                self._add_preview(message)
            case Features():
                if self.surprising.add_features(message, self.objects.models):
                    self._mark_changed("surprising")
            case End() if self.phase != "ended":
                self.phase, self.reason = "ended", message.reason
                self._mark_changed("status")

    def rate(self, now: float) -> float:
        """Return the frames per second over the last two seconds."""
        recent = takewhile(lambda moment: now - moment <= RATE_SECONDS, reversed(self._arrivals.values()))
        return len(list(recent)) / RATE_SECONDS

    def counter(self, process: str, name: str) -> float | None:
        """Return a counter from the last health report of a process, None if there is none."""
        return self.health[process].counters.get(name) if process in self.health else None

    def object_counters(self, process: str, name: str) -> dict[str, float]:
        """Return a counter of each object that is shown from the last health report of a process, by object."""
        objects = self.health[process].objects if process in self.health else {}
        return {each: objects[each][name] for each in self.objects.shown if name in objects.get(each, {})}

    def picture(self, frame: int) -> Preview | None:
        """Return the picture of a recent frame or of a surprising one, None if it is not kept."""
        if frame in self.pictures:
            return self.pictures[frame]
        return next((one.preview for one in self.surprising.frames if one.frame == frame), None)

    @property
    def newest(self) -> tuple[Preview, list[Track]] | None:
        """The newest picture, and the tracks of its frame as far as they have arrived."""
        preview = next(reversed(self.pictures.values()), None)
        if preview is None:
            return None
        tracks = self._tracks.get(preview.frame, {}).values()
        return preview, [track for track in tracks if track.object in self.objects.shown]

    def _add_health(self, health: Health, now: float) -> None:
        self.health[health.process] = health
        self.last_reports[health.process] = now
        self.source = health.source or self.source
        if health.process == "detector":
            self._add_objects(health)
        self._add_point(now)
        self._mark_changed("status", "trees")

    def _add_objects(self, health: Health) -> None:
        """Add and drop objects by a health report of the detector."""
        before = set(self.objects.shown)
        if dropped := self.objects.add_health(health):
            self.surprising.drop(dropped)
            self._mark_changed("surprising")
        if before != self.objects.shown.keys():
            self._mark_changed("tracks")

    def _add_track(self, track: Track, now: float) -> None:
        if self.objects.add_track(track):
            self.surprising.drop({track.object})
            self._mark_changed("surprising")
        if self._frame is None or track.frame != self._frame[0]:
            self._frame = track.frame, track.time
            self._tracks[track.frame], self._arrivals[track.frame] = {}, now
        self._tracks[track.frame][track.object] = track
        self._add_point(now)
        self._mark_changed("tracks")

    def _add_model(self, model: Model, now: float) -> None:
        arrived = self._arrivals.get(model.frame)
        self.objects.add_model(model, None if arrived is None else round(now - arrived, 3))

    def _add_preview(self, preview: Preview) -> None:
        self.pictures[preview.frame] = preview
        if self.surprising.measure(preview.frame):
            self._mark_changed("surprising")
        self._mark_changed("picture")

    def _add_point(self, now: float) -> None:
        if not self.objects.shown or now - self._last_point < POINT_SECONDS:
            return
        self._last_point = now
        objects = {
            name: (round(each.score, 3), each.model_latency, each.version, each.state != "absent")
            for name, each in self.objects.shown.items()
        }
        self._points.append((round(now, 3), self.rate(now), objects))
        self._mark_changed("points")

    def _status_part(self, _: int) -> dict[str, object]:
        return {
            "phase": self.phase,
            "reason": self.reason,
            "endpoint": self.endpoint,
            "source": self.source,
            "paused": bool(self.counter("detector", "paused")),
            "waiting": bool(self.counter("detector", "waiting")),
            "lost_seconds": self.counter("detector", "lost_seconds"),
            "skipped": self.counter("detector", "skipped"),
        }

    def _tracks_part(self, _: int) -> dict[str, object]:
        frame, time = self._frame or (None, None)
        objects = [
            {"name": name, "colour": each.colour, "state": each.state, "score": each.score, "version": each.version}
            for name, each in self.objects.shown.items()
        ]
        return {"frame": frame, "time": time, "objects": objects}

    def _picture_part(self, _: int) -> dict[str, object] | None:
        if self.newest is None:
            return None
        preview = self.newest[0]
        return {"frame": preview.frame, "width": preview.width, "height": preview.height, "boxes": preview.boxes}

    def _points_part(self, new: int) -> list[_Point]:
        return list(self._points)[-new:]

    def _trees_part(self, _: int) -> dict[str, object]:
        counted = self.health["compressor"].objects if "compressor" in self.health else {}
        objects = {
            name: {
                "leaves": [counters.get(f"{tree}_leaves", 0.0) for tree in TREES],
                "bytes": counters.get("bytes", 0.0),
                "rows": counters.get("rows", 0.0),
            }
            for name, counters in counted.items()
        }
        return {
            "kinds": [{"title": tree.title, "meaning": tree.meaning} for tree in TREES.values()],
            "objects": objects,
        }

    def _surprising_part(self, _: int) -> dict[str, object]:
        frames = [
            {"frame": one.frame, "object": one.object}
            | {"surprise": round(one.surprise, 3), "colour": self.objects.colours.of(one.object)}
            | {"box": one.preview.boxes[one.object], "width": one.preview.width, "height": one.preview.height}
            for one in self.surprising.frames
        ]
        return {"measured": self.surprising.measured, "frames": frames}


class FleetDashboard(Parts):
    """Receives the status of a fleet, and returns the updates for each open page: all streams and nodes, once a second.

    It keeps the last status while the fleet does not answer.

    Attributes
    ----------
    status : the last status, without a stream before the first
    age : seconds since the last status arrived, 0 while the fleet answers
    """

    def __init__(self) -> None:
        super().__init__(
            {
                "status": self._status_part,
                "streams": lambda _: {name: _stream(each) for name, each in self.status.streams.items()},
                "nodes": lambda _: {name: _node(each) for name, each in self.status.nodes.items()},
            }
        )
        self.status = FleetStatus("", 0.0)
        self.age = self._arrived = 0.0

    def take(self, status: FleetStatus, now: float) -> None:
        """Process a status that arrived at the time `now`, in seconds of a monotonic clock."""
        self.status, self.phase, self.reason, self.age, self._arrived = status, "running", "", 0.0, now
        self._mark_changed(*self._parts)

    def mark_silent(self, reason: str, now: float) -> None:
        """Record that the fleet did not answer at the time `now`."""
        super().mark_silent(reason, now)
        if self.phase == "silent":
            self.age = now - self._arrived

    def _status_part(self, _: int) -> dict[str, object]:
        return {"name": self.status.name, "phase": self.phase, "reason": self.reason, "age": int(self.age)}


def _stream(stream: StreamStatus) -> dict[str, Any]:
    """Return what the page shows of a stream; `picture` is whether it can show one of its newest frame."""
    names = ("state", "trouble", "node", "source", "frame", "skipped", "stored_seconds")
    return {name: getattr(stream, name) for name in names} | {
        "models": list(stream.models.items()),
        "picture": bool(stream.endpoint) and stream.state in RUNNING,
    }


def _node(node: NodeStatus) -> dict[str, Any]:
    """Return what the page shows of a node."""
    names = ("state", "address", "streams")
    return {name: getattr(node, name) for name in names} | {
        "cores": round(node.cores, 2),
        "used": round(node.used, 2),
        "labels": [f"{name}={value}" for name, value in sorted(node.labels.items())],
    }
