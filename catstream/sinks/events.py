"""Events: what happens to objects, from their tracks.

>>> from catstream.base.box import Box
>>> events = Events(SinkOptions(zones={"door": ((50, 0), (90, 0), (90, 90), (50, 90))}, lost_seconds=1))
>>> for frame, box in enumerate([Box(0, 40, 20, 20), Box(60, 40, 20, 20), None, None, Box(0, 40, 20, 20)]):
...     state = "absent" if box is None else "present"
...     for event in events.update([Track(frame + 1, frame, frame / 2, state, box, 0.9, 1)]):
...         print((event.track.time, event.kind, event.zone))
(0.0, 'found', '')
(0.5, 'entered', 'door')
(1.5, 'lost', '')
(2.0, 'returned', '')
(2.0, 'left', 'door')
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from catstream.jobs.job import SinkOptions
from catstream.messages.kinds import Track

#: Kind of an event -> when there is one.
KINDS = {
    "found": "an object has a box for the first time",
    "lost": "it has had no box for some seconds",
    "returned": "it has a box again after that",
    "entered": "the centre of its box is in a zone",
    "left": "the centre is outside the zone again, by more than the margin; or the object ended in it",
    "ended": "it was forgotten, another object got its name, or the tracks ended",
}

#: More frames than these, with tracks of other objects, end an object without a track. A subscriber that loses messages
#: may have no track of an object in two of the frames of which it has any, and in the next one that of another first.
_FORGOTTEN_FRAMES = 3


@dataclass(frozen=True, slots=True)
class Event:
    """An event of an object.

    kind   one of `KINDS`
    track  its track in the frame of the event; its last one if it ended
    zone   name of the zone; empty if it is about none
    """

    kind: str
    track: Track
    zone: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The fields by name, of plain types for JSON, with the object and time of the track."""
        track = self.track.to_dict()
        about = {"event": self.kind, "object": track["object"], "time": track["time"], "zone": self.zone or None}
        return {**about, "track": track}


@dataclass(slots=True)
class _Object:
    """What is known of an object: its newest track, and how many frames there were up to it; the time of its last box.

    If it has had no box yet, `seen` is None.
    """

    track: Track
    frames: int = 0
    seen: float | None = None
    lost: bool = False
    zones: list[str] = field(default_factory=list)


class Events:
    """Turns the tracks of a run, in their order, into events; it does no I/O, and time is that of the tracks.

    A zone is entered as soon as the centre of a box is in it, and left if the centre is more than `options.margin`
    pixels outside. An object that is lost stays in its zones until it is seen elsewhere.
    """

    def __init__(self, options: SinkOptions) -> None:
        self._options = options
        self._zones = {name: np.array(corners, np.float32) for name, corners in options.zones.items()}
        self._objects: dict[str, _Object] = {}
        self._frame, self._frames = -1, 0  # number of the newest frame, and how many there were

    def update(self, tracks: Sequence[Track]) -> list[Event]:
        """Return the events of further tracks: those of a frame, together or one by one."""
        events: list[Event] = []
        for track in tracks:
            if track.frame != self._frame:
                self._frame, self._frames = track.frame, self._frames + 1
            events += self._of(track)
        for name, known in [*self._objects.items()]:
            if self._frames - known.frames > _FORGOTTEN_FRAMES:
                events += self._end(name)
        return self._wanted(events)

    def close(self) -> list[Event]:
        """Return the last events: all objects end."""
        return self._wanted([event for name in [*self._objects] for event in self._end(name)])

    def status(self, name: str) -> dict[str, Any] | None:
        """Whether an object is present, that is found and not lost, and the names of its zones; None if it ended."""
        known = self._objects.get(name)
        if known is None:
            return None
        return {"present": known.seen is not None and not known.lost, "zones": known.zones}

    def _wanted(self, events: list[Event]) -> list[Event]:
        return [event for event in events if event.kind in self._options.events]

    def _of(self, track: Track) -> Iterator[Event]:
        """Yield the events of a track, except the end of other objects."""
        known = self._objects.get(track.object)
        if known is not None and known.track.began != track.began:
            yield from self._end(track.object)
            known = None
        known = known or self._objects.setdefault(track.object, _Object(track))
        known.track, known.frames = track, self._frames
        if track.box is None:
            if known.seen is not None and not known.lost and track.time - known.seen >= self._options.lost_seconds:
                known.lost = True
                yield Event("lost", track)
            return
        if known.seen is None or known.lost:
            yield Event("found" if known.seen is None else "returned", track)
        known.seen, known.lost = track.time, False
        for name, corners in self._zones.items():
            inside = cv2.pointPolygonTest(corners, track.box.centre, measureDist=True)  # pixels; negative if outside
            if name not in known.zones and inside >= 0:
                known.zones.append(name)
                yield Event("entered", track, name)
            elif name in known.zones and inside < -self._options.margin:
                known.zones.remove(name)
                yield Event("left", track, name)

    def _end(self, name: str) -> Iterator[Event]:
        known = self._objects.pop(name)
        yield from (Event("left", known.track, zone) for zone in known.zones)
        yield Event("ended", known.track)
