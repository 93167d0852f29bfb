"""The dashboard: what the page shows of a pipeline, from the messages it sends. No socket, no clock."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from typing import Any, Literal

from catstream.heads import HEADS
from catstream.messages import End, Features, Health, Model, Preview, Track
from catstream.web.surprising import SurprisingFrames

__all__ = ["SILENCE_SECONDS", "Dashboard", "Phase"]

#: How the pipeline is: not heard yet, heard, silent since, at its end.
Phase = Literal["waiting", "running", "silent", "ended"]

#: After which who says nothing is gone: each process is heard once a second.
SILENCE_SECONDS = 4.0

_POINT_SECONDS = 0.25
_POINTS = 480  # two minutes
_RATE_SECONDS = 2.0  # that frames a second are counted over
_FRAMES = 4096  # whose arrival is remembered, until a model has learned from them
_MONOTONIC_COUNTERS = ("sent", "rows")  # counters that only grow in one pipeline, of one object
_LATE_HEALTH_SECONDS = 3.0  # that the processes may still be heard after the end
_TRACKS = 256  # that are kept until the picture of their frame is here
_PICTURES = 8  # a page that asks for the last but one still gets it


class Dashboard:
    """Takes messages, and tells each page what is new to it.

    What it shows is of one pipeline. At the first track or health of another one it forgets all of the one before;
    until then it keeps the last picture and figures.

    phase, reason : of the pipeline
    endpoint, source : where it runs, and the source that it follows
    health : what each process said last
    heard : when each was heard last, of those that are not silent since
    """

    def __init__(self) -> None:
        self.endpoint = self._attached = ""
        self._revisions: Counter[str] = Counter(
            pipeline=1, trees=1
        )  # told first: a page clears what it shows of another
        self._reset()

    def _reset(self) -> None:
        """Begin with a pipeline of which nothing is known."""
        self.phase: Phase = "waiting"
        self.reason = self.source = ""
        self.track: Track | None = None
        self.health: dict[str, Health] = {}
        self.last_reports: dict[str, float] = {}
        self.model_latency: float | None = None
        self.surprising = SurprisingFrames()
        self.pictures: OrderedDict[int, Preview] = OrderedDict()
        self._last: dict[str, Health] = {}  # as `health`, and kept while the pipeline is silent
        self._model: Model | None = None
        self._since = 0  # first frame of the object that is followed
        self._points: deque[tuple[float | None, ...]] = deque(maxlen=_POINTS)
        self._last_point = self._ended = float("-inf")  # when the last point was made, and when the pipeline ended
        self._moments: deque[float] = deque()
        self._arrivals: OrderedDict[int, float] = OrderedDict()
        self._tracks: OrderedDict[int, Track] = OrderedDict()  # the last ones, by frame

    def attach(self, endpoint: str) -> None:
        """What comes from now on comes from here; what is shown stays until something comes."""
        self._attached = endpoint
        if self.phase == "waiting":
            self.endpoint = endpoint
            self._mark_changed("status")

    def take(self, message: Any, now: float) -> None:
        """Take a message that came at a moment `now`, seconds of any clock that only goes forward."""
        if self._is_from_another_pipeline(message, now):
            self._reset()
            self._mark_changed("pipeline", "status", "track", "picture", "trees", "surprising")
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
                if self.surprising.add_features(message):
                    self._mark_changed("surprising")
            case End() if self.phase != "ended":
                self.phase, self.reason, self._ended = "ended", message.reason, now
                self._mark_changed("status")

    def mark_silent(self, reason: str) -> None:
        """The pipeline is silent, or there is none."""
        if self.phase == "running":
            self.phase = "silent"
        if self.phase != "ended":
            self.reason = reason
        self.health.clear()
        self.last_reports.clear()
        self._mark_changed("status")

    def rate(self, now: float) -> float:
        """Frames a second, over the last two."""
        while self._moments and now - self._moments[0] > _RATE_SECONDS:
            self._moments.popleft()
        return len(self._moments) / _RATE_SECONDS

    def counter(self, process: str, name: str) -> float | None:
        """What a process said last of something that it counts."""
        return self.health[process].counters.get(name) if process in self.health else None

    def picture(self, frame: int) -> Preview | None:
        """The picture of a frame that was told of lately, or that is in the surprising."""
        if frame in self.pictures:
            return self.pictures[frame]
        return next((one.preview for one in self.surprising.frames if one.frame == frame), None)

    @property
    def newest(self) -> tuple[Preview, Track | None] | None:
        """The newest picture and the track of its frame, None for a track that did not come."""
        preview = next(reversed(self.pictures.values()), None)
        return None if preview is None else (preview, self._tracks.get(preview.frame))

    def updates(self, seen: dict[str, int]) -> dict[str, Any]:
        """The parts that are new to a page, ready for JSON.

        Parameters
        ----------
        seen : what it was told of, empty at first; brought up to date
        """
        parts = {}
        for name, revision in self._revisions.items():
            if seen.get(name) != revision:
                parts[name] = getattr(self, f"_{name}_part")(revision - seen.get(name, 0))
                seen[name] = revision
        return parts

    def _is_from_another_pipeline(self, message: Any, now: float) -> bool:
        """Whether a message shows that another pipeline is there than the one that is shown."""
        if not isinstance(message, Track | Health):
            return False
        if self._attached != self.endpoint:
            self.endpoint = self._attached
            return True
        if isinstance(message, Track):  # a restarted detector goes on, or began before the first model
            over = self.track is not None and message.seq < self.track.seq and not message.model_version
            return over or self.phase == "ended"
        before = self._last.get(message.process, message).counters
        over = any(message.counters.get(name, 0.0) < before.get(name, 0.0) for name in _MONOTONIC_COUNTERS)
        late = self.phase == "ended" and now - self._ended > _LATE_HEALTH_SECONDS
        return late or (over and self.phase in ("ended", "silent"))

    def _add_health(self, health: Health, now: float) -> None:
        self.health[health.process] = health
        heard = self.last_reports | {health.process: now}
        self.last_reports = {name: last for name, last in heard.items() if now - last <= SILENCE_SECONDS}
        self._last[health.process] = health
        self.source = health.source or self.source
        if self.phase in ("waiting", "silent"):
            self.phase, self.reason = "running", ""
        self._add_point(now)
        self._mark_changed("status", "trees")

    def _add_track(self, track: Track, now: float) -> None:
        if self.phase != "running":
            self.phase, self.reason = "running", ""
            self._mark_changed("status")
        if self.track is not None and track.model_version < self.track.model_version:
            self._begin_object(track.frame)
        self.track = self._tracks[track.frame] = track
        if len(self._tracks) > _TRACKS:
            self._tracks.popitem(last=False)
        self._moments.append(now)
        self._arrivals[track.frame] = now
        if len(self._arrivals) > _FRAMES:
            self._arrivals.popitem(last=False)
        self._add_point(now)
        self._mark_changed("track")

    def _begin_object(self, frame: int) -> None:
        """Another object is followed from this frame on: what was learned before is of no meaning to it."""
        self._since, self.surprising, self.model_latency = frame, SurprisingFrames(), None
        self._arrivals.clear()
        if self._model is not None and self._model.frame >= frame:  # it came before the track
            self.surprising.adopt(self._model)
        self._mark_changed("surprising")

    def _add_model(self, model: Model, now: float) -> None:
        if model.frame < self._since:  # of the object before
            return
        self._model = model
        self.surprising.adopt(model)
        if (arrived := self._arrivals.get(model.frame)) is not None:
            self.model_latency = now - arrived
        while self._arrivals and next(iter(self._arrivals)) <= model.frame:
            self._arrivals.popitem(last=False)

    def _add_preview(self, preview: Preview) -> None:
        self.pictures[preview.frame] = preview
        self.pictures.move_to_end(preview.frame)
        if len(self.pictures) > _PICTURES:
            self.pictures.popitem(last=False)
        if self.surprising.add_preview(preview):
            self._mark_changed("surprising")
        self._mark_changed("picture")

    def _add_point(self, now: float) -> None:
        if self.track is None or now - self._last_point < _POINT_SECONDS:
            return
        self._last_point, present = now, self.track.state != "absent"
        self._points.append(
            (now, self.track.score, self.rate(now), self.model_latency, self.track.model_version, present)
        )
        self._mark_changed("points")

    def _mark_changed(self, *parts: str) -> None:
        self._revisions.update(parts)

    def _status_part(self, _: int) -> dict[str, Any]:
        return {
            "phase": self.phase,
            "reason": self.reason,
            "endpoint": self.endpoint,
            "source": self.source,
            "processes": sorted(self.last_reports),
            "paused": bool(self.counter("detector", "paused")),
            "waiting": bool(self.counter("detector", "waiting")),
            "lost_seconds": self.counter("detector", "lost_seconds"),
            "skipped": self.counter("detector", "skipped"),
        }

    def _track_part(self, _: int) -> dict[str, Any] | None:
        if (track := self.track) is None:
            return None
        return {"frame": track.frame, "time": track.time, "state": track.state, "version": track.model_version}

    def _pipeline_part(self, _: int) -> int:
        """Which one is shown, counted: where another is, all parts come anew."""
        return self._revisions["pipeline"]

    def _picture_part(self, _: int) -> dict[str, Any] | None:
        if self.newest is None:
            return None
        preview = self.newest[0]
        return {"frame": preview.frame, "width": preview.width, "height": preview.height, "box": preview.box}

    def _points_part(self, new: int) -> list[list[float | None]]:
        return [[value if value is None else round(value, 3) for value in point] for point in list(self._points)[-new:]]

    def _trees_part(self, _: int) -> dict[str, Any]:
        counted = self._last["compressor"].counters if "compressor" in self._last else {}
        return {
            "trees": [
                {"title": head.title, "meaning": head.meaning, "leaves": counted.get(f"{name}_leaves")}
                for name, head in HEADS.items()
            ],
            "bytes": counted.get("bytes"),
            "rows": counted.get("rows"),
        }

    def _surprising_part(self, _: int) -> dict[str, Any]:
        frames = [
            {"frame": one.frame, "time": one.time, "surprise": round(one.surprise, 3), "box": one.preview.box}
            | {"width": one.preview.width, "height": one.preview.height}
            for one in self.surprising.frames
        ]
        return {"measured": self.surprising.measured, "frames": frames}
