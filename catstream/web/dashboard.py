"""The state of the page of a pipeline, computed from its messages, without sockets and without a clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, Literal, TypeVar

from catstream.video.drawing import Colours
from catstream.wire.heads import TREES
from catstream.wire.messages import End, Health, Model, Preview, State, Track, run_state

Key = TypeVar("Key")
Value = TypeVar("Value")

#: Phase of a pipeline: no message yet, running, silent for some seconds, ended.
Phase = Literal["waiting", "running", "silent", "ended"]

POINT_SECONDS = 0.25  #: interval between two points of the charts
RATE_SECONDS = 2.0  #: window for the frame rate
_POINTS = 480  # two minutes
_FRAMES = 4096  # number of stored arrival times of frames, for the latency of models
_TRACKS = 256  # number of frames whose tracks are stored until their picture arrives
_PICTURES = 64  # number of stored pictures, for pages with a slow connection
_SHOWN_OF_A_PICTURE = ("frame", "time", "width", "height", "boxes")

#: A point of the charts: time, frames per second, and for each object its score, model latency, model version and
#: presence.
_Point = tuple[float, float, dict[str, tuple[float, float | None, int, bool]]]


@dataclass(slots=True)
class TrackedObject:
    """A tracked object.

    colour         colour of its box, #rrggbb
    state, score   of its newest track
    version        model version of its newest track
    began          number of its first frame, None before its first track
    seq            number of its newest track, 0 before the first
    trained        version of its newest received model
    model_latency  seconds from the track of a frame to the model that was trained on it, None before the first model
    """

    colour: str
    state: State = "absent"
    score: float = 0.0
    version: int = 0
    began: int | None = None
    seq: int = 0
    trained: int = 0
    model_latency: float | None = None


class Dashboard:
    """Receives messages, and returns the parts of the page that have changed.

    It shows one pipeline. The last picture and figures remain until the first message of another pipeline resets the
    state.
    """

    def __init__(self) -> None:
        self.endpoint = self._attached = ""
        self._run = ""  # id of the present run
        self._earlier_runs: set[str] = set()  # ids of runs whose last messages may still arrive
        self._reset()

    def _reset(self) -> None:
        """Drop all state of the previous pipeline."""
        self.phase: Phase = "waiting"
        self.reason = ""  #: reason of the end or of the silence
        self.source = ""
        self.objects: dict[str, TrackedObject] = {}  #: by name, in order of their beginning
        self.colours = Colours()
        self.health: dict[str, Health] = {}  #: last report of each process
        self.last_reports: dict[str, float] = {}  #: arrival times of these reports
        self._pictures: dict[float, Preview] = {}  # by time, because skipped frames of a live source share a number
        self._points: deque[_Point] = deque(maxlen=_POINTS)
        self._arrivals: dict[int, float] = {}  # arrival time of the first track of each frame
        self._tracks: dict[int, dict[str, Track]] = {}  # by frame and object
        self._frame: tuple[int, float] | None = None  # number and time of the newest frame
        self._seq = 0  # of the newest track

    def updates(self, sent: dict[str, Any]) -> dict[str, Any]:
        """Return the parts that have changed since the last call with `sent`, a dictionary that is empty at first.

        For a new pipeline, all parts are returned, beginning with `pipeline`. Only new points are returned.
        """
        parts = {
            "pipeline": len(self._earlier_runs),
            "status": self._status_part(),
            "tracks": self._tracks_part(),
            "picture": self._picture_part(),
            "trees": self._trees_part(),
        }
        if sent.get("pipeline") != parts["pipeline"]:
            sent.clear()
        last = sent["points"][-1][0] if "points" in sent else float("-inf")
        changed = {name: part for name, part in parts.items() if name not in sent or sent[name] != part}
        if points := [point for point in self._points if point[0] > last]:
            changed["points"] = points
        sent.update(changed)
        return changed

    def mark_silent(self, reason: str) -> None:
        """Record that nothing arrives."""
        if self.phase == "running":
            self.phase = "silent"
        if self.phase != "ended":
            self.reason = reason

    def attach(self, endpoint: str) -> None:
        """Expect messages from this endpoint; the state remains until the first one arrives."""
        self._attached = endpoint
        if self.phase == "waiting":
            self.endpoint = endpoint

    def take(self, message: object, now: float, run: str = "") -> None:
        """Process a message that arrived at the time `now`, in seconds of a monotonic clock.

        `run` is the id of its run, by default the present one.
        """
        if run in self._earlier_runs:
            return
        if run and run != self._run:
            if self._run:
                self._earlier_runs.add(self._run)
                self._reset()
            self._run, self.endpoint = run, self._attached
        if self.phase in ("waiting", "silent") and not isinstance(message, End):
            self.phase, self.reason = "running", ""
        match message:
            case Track():
                self._add_track(message, now)
            case Model():
                self._add_model(message, now)
            case Health():
                self._add_health(message, now)
            case Preview():
                _remember(self._pictures, message.time, message, _PICTURES)
            case End() if self.phase != "ended":
                self.phase, self.reason = "ended", message.reason

    @property
    def state(self) -> tuple[str, str]:
        """Name and description of the state of the pipeline: of the run while it runs, otherwise of the phase."""
        if self.phase != "running":
            return {
                "waiting": ("none", "no pipeline runs"),
                "silent": ("silent", "the pipeline sends no messages"),
                "ended": ("ended", "ended"),
            }[self.phase]
        counters = self.health["detector"].counters if "detector" in self.health else {"sent": 0.0}
        if self._seq > counters.get("sent", 0.0):  # a frame was tracked after the report
            return "running", "running"
        return run_state(counters) if "detector" in self.health else ("starting", "starting")

    @property
    def _suspended(self) -> bool:
        """True if no frames are tracked, so the positions of the objects are unknown."""
        return self.state[0] in ("lost", "waiting", "paused")

    def rate(self, now: float) -> float:
        """Return the frames per second over the last two seconds."""
        recent = takewhile(lambda moment: now - moment <= RATE_SECONDS, reversed(self._arrivals.values()))
        return len(list(recent)) / RATE_SECONDS

    def picture(self, time: float) -> Preview | None:
        """Return the picture of the frame at a time, None if it is no longer stored."""
        return self._pictures.get(time)

    @property
    def newest(self) -> tuple[Preview, list[Track]] | None:
        """The newest picture, and the received tracks of its frame."""
        preview = next(reversed(self._pictures.values()), None)
        if preview is None:
            return None
        tracks = self._tracks.get(preview.frame, {}).values()
        return preview, [track for track in tracks if track.object in self.objects]

    def _add_track(self, track: Track, now: float) -> None:
        self._seq = track.seq
        name, previous = track.object, self.objects.get(track.object)
        if previous is None or previous.began not in (None, track.began):  # a new object with this name
            self.objects[name] = TrackedObject(self.colours.of(name))
        tracked = self.objects[name]
        tracked.state, tracked.score, tracked.version = track.state, track.score, track.model_version
        tracked.seq, tracked.began = track.seq, track.began
        if self._frame is None or track.frame != self._frame[0]:
            self._frame = track.frame, track.time
            _remember(self._tracks, track.frame, {}, _TRACKS)
            _remember(self._arrivals, track.frame, now, _FRAMES)
        self._tracks[track.frame][name] = track
        self._add_point(now)

    def _add_model(self, model: Model, now: float) -> None:
        """Measure the latency of a new model of an object; models of an earlier object with its name are ignored."""
        tracked, arrived = self.objects.get(model.object), self._arrivals.get(model.frame)
        if tracked is None or tracked.began != model.began or tracked.trained == model.version:
            return
        tracked.trained = model.version
        if arrived is not None:
            tracked.model_latency = round(now - arrived, 3)

    def _add_health(self, health: Health, now: float) -> None:
        self.health[health.process] = health
        self.last_reports[health.process] = now
        self.source = health.source or self.source
        if health.process == "detector":
            self._add_objects(health)
        self._add_point(now)

    def _add_objects(self, health: Health) -> None:
        """Add the objects of the detector's report that have no track yet, and drop objects that it lacks."""
        if len(health.objects) != health.counters.get("objects"):  # some objects have no track yet
            return
        for name, counters in health.objects.items():
            if name not in self.objects:
                version = int(counters.get("model_version", 0))
                state: State = "absent" if not counters.get("present") else "present" if version else "bootstrapping"
                self.objects[name] = TrackedObject(self.colours.of(name), state, counters.get("score", 0.0), version)
        sent = health.counters.get("sent", 0)  # objects with a later track may have begun after the report
        for name, tracked in list(self.objects.items()):
            if name not in health.objects and tracked.seq <= sent:
                del self.objects[name]
        self.colours.keep(self.objects)

    def _add_point(self, now: float) -> None:
        if not self.objects or (self._points and now - self._points[-1][0] < POINT_SECONDS):
            return
        objects = {
            name: (round(tracked.score, 3), tracked.model_latency, tracked.version, tracked.state != "absent")
            for name, tracked in ({} if self._suspended else self.objects).items()
        }
        self._points.append((round(now, 3), self.rate(now), objects))

    def _status_part(self) -> dict[str, object]:
        counters = self.health["detector"].counters if "detector" in self.health else {}
        state, words = self.state
        return {name: getattr(self, name) for name in ("phase", "reason", "endpoint", "source")} | {
            "state": state,
            "words": words,
            "paused": bool(counters.get("paused")),
            "skipped": counters.get("skipped"),
        }

    def _tracks_part(self) -> dict[str, object]:
        frame, time = self._frame or (None, None)
        objects = [
            {"name": name, "colour": tracked.colour, "version": tracked.version}
            | {"state": None if self._suspended else tracked.state, "score": None if self._suspended else tracked.score}
            for name, tracked in self.objects.items()
        ]
        return {"frame": frame, "time": time, "objects": objects}

    def _picture_part(self) -> dict[str, object] | None:
        preview = next(reversed(self._pictures.values()), None)
        return preview if preview is None else {name: getattr(preview, name) for name in _SHOWN_OF_A_PICTURE}

    def _trees_part(self) -> dict[str, object]:
        counted = self.health["compressor"].objects if "compressor" in self.health else {}
        kinds = [{"title": tree.title, "meaning": tree.meaning} for tree in TREES.values()]
        objects = {
            name: {"leaves": [counters.get(f"{tree}_leaves", 0.0) for tree in TREES]}
            | {counter: counters.get(counter, 0.0) for counter in ("bytes", "rows")}
            for name, counters in counted.items()
        }
        return {"kinds": kinds, "objects": objects}


def _remember(recent: dict[Key, Value], key: Key, value: Value, most: int) -> None:
    """Set an entry of a dictionary that stores the last `most` entries."""
    recent.pop(key, None)
    recent[key] = value
    if len(recent) > most:
        del recent[next(iter(recent))]
