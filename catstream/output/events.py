"""Detects events of objects in their tracks, and events of the run in its health reports.

>>> from catstream.base.box import Box
>>> events = Events({"door": ((50, 0), (90, 0), (90, 90), (50, 90))}, WHEN | {"lost": 1.0})
>>> for frame, box in enumerate([Box(0, 40, 20, 20), Box(60, 40, 20, 20), None, None, Box(0, 40, 20, 20)]):
...     state = "absent" if box is None else "present"
...     for event in events.update([Track(frame, frame / 2, state, box, 0.9, 1)]):
...         print((event.track.time, event.kind, event.zone))
(0.0, 'found', '')
(0.5, 'entered', 'door')
(1.5, 'left', 'door')
(1.5, 'lost', '')
(2.0, 'returned', '')
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from catstream.base.names import check_name
from catstream.errors import ObjectError, SettingsError
from catstream.wire.messages import Health, Track

#: x and y, in pixels of the frame.
Point = tuple[float, float]

#: Descriptions of the kinds of events.
KINDS = {
    "found": "an object has a box for the first time",
    "lost": "it has had no box for some seconds",
    "returned": "it has a box again after that",
    "entered": "the centre of its box is in a zone",
    "left": "the centre is outside the zone again, by more than 10 pixels; or the object was lost or ended in it",
    "ended": "it was forgotten, another object got its name, or the tracks ended",
    "source_lost": "a live source has been lost for the seconds of `lost`",
    "source_back": "it is connected again after that",
    "write_failed": "results of a live source, or checkpoints, cannot be written",
    "write_resumed": "they can be written again",
}

#: All kinds; the value of "lost" is the time in seconds without a box, or without a source, that counts as lost.
WHEN = dict.fromkeys(KINDS, 0.0) | {"lost": 2.0}

#: Hysteresis: distance from a zone, in pixels, at which a centre has left it.
MARGIN = 10.0

#: An object without a track ends after more than this number of frames with tracks of other objects. A subscriber that
#: loses messages may miss an object in two frames, and receive another object first in the next frame.
_FORGOTTEN_FRAMES = 3


@dataclass(frozen=True, slots=True)
class Event:
    """An event of an object or of the run.

    kind   one of `KINDS`
    track  track of the object in the frame of the event, or its last one if it ended; None for an event of the run
    zone   name of the zone, or empty
    facts  for an event of the run: its `source`, and the `seconds` for which it was lost, or the number of `frames`
           that were not written and the `reason`
    """

    kind: str
    track: Track | None
    zone: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The fields by name, with the types of JSON, and with the object and time of the track."""
        if self.track is None:
            return {"event": self.kind, **dict.fromkeys(("object", "time", "zone", "track")), **self.facts}
        track = self.track.to_dict()
        about = {"event": self.kind, "object": track["object"], "time": track["time"], "zone": self.zone or None}
        return {**about, "track": track}


@dataclass(slots=True)
class _Object:
    """The state of an object.

    track     newest track
    frames    number of frames up to it
    box_time  time of the last box, None before the first
    is_known  False if the source was lost after the newest track
    """

    track: Track
    frames: int = 0
    box_time: float | None = None
    lost: bool = False
    is_known: bool = True
    zones: list[str] = field(default_factory=list)


class Events:
    """Detects events in the tracks of a run, in order; without I/O, and with the time of the tracks.

    source_lost  whether the source is lost
    tracks       newest track of each object

    A zone is entered as soon as the centre of a box is in it, and left if the centre is more than `MARGIN` pixels
    outside, or if the object is lost or ends. Each `entered` is followed by `left`, and a lost object is in no zone.

    zones : corners x, y of each polygon, in pixels, by name; SettingsError if one is invalid, see `check_zones`
    when : kinds of events that are returned, see `WHEN`
    """

    def __init__(self, zones: Mapping[str, Sequence[Point]], when: Mapping[str, float] = WHEN) -> None:
        check_zones(zones)
        self._zones = {name: np.array(corners, np.float32) for name, corners in zones.items()}
        self._when, self._lost_seconds = when, when.get("lost", WHEN["lost"])
        self._objects: dict[str, _Object] = {}
        self.source_lost, self._source, self._source_seconds = False, "", 0.0
        self._write_problems: dict[str, str] = {}  # by process
        self._frame, self._frames = -1, 0  # number of the newest frame, and number of frames so far

    def update(self, tracks: Sequence[Track]) -> list[Event]:
        """Return the events of tracks of a frame, passed together or one by one."""
        events: list[Event] = []
        for track in tracks:
            if track.frame != self._frame:
                self._frame, self._frames = track.frame, self._frames + 1
            events += self._of(track)
        for name, item in [*self._objects.items()]:
            if self._frames - item.frames > _FORGOTTEN_FRAMES:
                events += self._end(name)
        return self._selected(events)

    def update_run(self, report: Health) -> list[Event]:
        """Return the events of the run in the next health report of a process.

        The status of an object is unknown from `source_lost` to its next track.
        """
        process, counters, events = report.process, report.counters, dict[str, dict[str, Any]]()
        self._source = report.source or self._source
        if (seconds := counters.get("lost_seconds")) is not None:
            if seconds and seconds >= self._lost_seconds and not self.source_lost:
                self.source_lost = True
                events["source_lost"] = {"seconds": round(seconds, 1)}
                for item in self._objects.values():
                    item.is_known = False
            elif not seconds and self.source_lost:
                self.source_lost = False
                events["source_back"] = {"seconds": round(self._source_seconds, 1)}
            self._source_seconds = seconds
        if (failed := counters.get("write_failed")) is not None:  # None until a restarted process has tried to write
            before, problem = self._write_problems.get(process, ""), report.trouble if failed else ""
            self._write_problems[process] = problem
            if bool(before) != bool(problem):
                facts = {"frames": int(counters.get("not_written", 0)), "reason": problem or before}
                events["write_failed" if problem else "write_resumed"] = facts
        return self._selected([Event(kind, None, facts={"source": self._source, **events[kind]}) for kind in events])

    @property
    def tracks(self) -> list[Track]:
        return [item.track for item in self._objects.values()]

    def close(self) -> list[Event]:
        """End all objects, and return the last events."""
        return self._selected([event for name in [*self._objects] for event in self._end(name)])

    def status(self, name: str) -> dict[str, Any] | None:
        """The status of an object: whether it is present, and the names of its zones; None if it ended.

        While the source is lost, `present` is None, and there are no zones.
        """
        item = self._objects.get(name)
        if item is None:
            return None
        if not item.is_known:
            return {"present": None, "zones": []}
        return {"present": item.box_time is not None and not item.lost, "zones": [*item.zones]}

    def _selected(self, events: list[Event]) -> list[Event]:
        return [event for event in events if event.kind in self._when]

    def _of(self, track: Track) -> Iterator[Event]:
        """Yield the events of a track."""
        # Step 1: a new object with the same name ends the old one.
        item = self._objects.get(track.object)
        if item is not None and item.track.began != track.began:
            yield from self._end(track.object)
            item = None
        item = item or self._objects.setdefault(track.object, _Object(track))
        item.track, item.frames, item.is_known = track, self._frames, True
        # Step 2: an absent object is lost after some seconds.
        if track.box is None:
            if item.box_time is None or item.lost or track.time - item.box_time < self._lost_seconds:
                return
            item.lost = True
            yield from self._leave_zones(item)
            yield Event("lost", track)
            return
        # Step 3: a present object is found or returns, and enters or leaves zones.
        if item.box_time is None or item.lost:
            yield Event("found" if item.box_time is None else "returned", track)
        item.box_time, item.lost = track.time, False
        for name, corners in self._zones.items():
            inside = cv2.pointPolygonTest(corners, track.box.centre, measureDist=True)  # pixels; negative if outside
            if name not in item.zones and inside >= 0:
                item.zones.append(name)
                yield Event("entered", track, name)
            elif name in item.zones and inside < -MARGIN:
                item.zones.remove(name)
                yield Event("left", track, name)

    def _end(self, name: str) -> Iterator[Event]:
        item = self._objects.pop(name)
        yield from self._leave_zones(item)
        yield Event("ended", item.track)

    @staticmethod
    def _leave_zones(item: _Object) -> Iterator[Event]:
        while item.zones:
            yield Event("left", item.track, item.zones.pop(0))


def check_zones(zones: Mapping[str, Sequence[Point]], size: tuple[int, int] | None = None) -> None:
    """Raise SettingsError if a zone has an invalid name, is not a simple polygon in pixels, or is outside the frame.

    Without the `size` of a frame, the last condition is not checked. The rules for the names of objects apply: such
    names are safe in topics, file names and templates.

    >>> check_zones({"door": [(0.1, 0.1), (0.9, 0.1), (0.9, 0.9)]})
    Traceback (most recent call last):
    catstream.errors.SettingsError: zone door: all corners are within 0 to 1: use pixels of the frame, not fractions
    """
    for name, corners in zones.items():
        try:
            check_name(name or " ")
        except ObjectError as error:
            raise SettingsError(f"zone: {error}") from None
        if wrong := _defect(np.array(corners, np.float32), size):
            raise SettingsError(f"zone {name}: {wrong}")


def _defect(corners: np.ndarray, size: tuple[int, int] | None) -> str:
    """Describe the defect of the corners of a zone, float32 (n, 2); empty if they are valid."""
    if len(corners) < 3:
        return f"a polygon has at least 3 corners, got {len(corners)}"
    if not np.isfinite(corners).all():
        return "its corners have to be finite numbers"
    if corners.min() >= 0 and corners.max() <= 1:
        return "all corners are within 0 to 1: use pixels of the frame, not fractions"
    edges = [*zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    if any(_cross(*one, *other) for one, other in combinations(edges, 2)):
        return "its edges cross: list the corners in their order around it"
    if cv2.contourArea(corners) < 1:
        return "its area is less than a pixel: its corners are on a line"
    if size is None:
        return ""
    pixels = corners.clip(-1e6, 1e6).round().astype(np.int32)
    is_inside = cv2.fillPoly(np.zeros(size[::-1], np.uint8), [pixels], 1).any()
    return "" if is_inside else f"it is outside the frame of {size[0]}x{size[1]} pixels"


def _cross(start: np.ndarray, end: np.ndarray, other_start: np.ndarray, other_end: np.ndarray) -> bool:
    """Return True if two line segments cross at a point inside both."""

    def side(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sign((b[0] - a[0]) * (point[1] - a[1]) - (b[1] - a[1]) * (point[0] - a[0])))

    return (
        side(other_start, start, end) * side(other_end, start, end) < 0
        and side(start, other_start, other_end) * side(end, other_start, other_end) < 0
    )
