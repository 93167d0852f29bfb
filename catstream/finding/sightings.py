"""Sightings of objects, and their intervals: the sightings of one object that follow one another in a file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from catstream.box import Box

__all__ = ["GAP_SECONDS", "Interval", "Linker", "Sighting"]

#: Longest time between two sightings of an interval.
GAP_SECONDS = 1.0

_SPEED = 3.0  # highest speed of an object, in multiples of its size a second
_JUMP = 0.5  # distance that any two successive sightings may have, in multiples of the object's size
_GROWTH = 1.6  # highest ratio of the sizes of two successive sightings


@dataclass(frozen=True, slots=True)
class Sighting:
    """An object that was found in a frame.

    Attributes
    ----------
    object : str
        Name of the object.
    file : str
        The video, the image, or the folder of images.
    frame : int
        Number of the frame, or of the image in its folder; the first one is 0.
    time : float
        Seconds since the start of the video.
    box : Box
        Box of the object in pixels of the frame.
    score : float
        About 1 on the object, near 0 elsewhere; at least the threshold of the search.
    image : str
        Name of the file in a folder of images, otherwise empty.
    """

    object: str
    file: str
    frame: int
    time: float
    box: Box
    score: float
    image: str = ""


@dataclass(slots=True)
class Interval:
    """The sightings of one object that follow one another.

    first, last  first and last sighting
    best         the one with the highest score
    count        number of sightings
    picture      JPEG of the best one, if it was made
    """

    first: Sighting
    last: Sighting
    best: Sighting
    count: int = 1
    picture: bytes = b""

    def extend(self, sighting: Sighting) -> None:
        self.last = sighting
        self.count += 1
        if sighting.score > self.best.score:
            self.best = sighting


@dataclass(slots=True)
class Linker:
    """Links the sightings of a file into intervals, frame by frame.

    A sighting continues an interval of its object if that ended at most a second ago and the object can have moved
    there: by half its size and three times its size in a second, with its size changed by a factor of 1.6, at most.

    gap_seconds  longest time between two sightings of an interval
    intervals    of all objects, in the order of their first sighting
    """

    gap_seconds: float = GAP_SECONDS
    intervals: list[Interval] = field(default_factory=list)
    _open: list[Interval] = field(default_factory=list)

    def add(self, sightings: Iterable[Sighting]) -> list[Interval]:
        """Link the sightings of one frame; returns their intervals, in the same order."""
        found: list[Interval] = []
        for sighting in sightings:
            self._open = [each for each in self._open if sighting.time - each.last.time <= self.gap_seconds]
            able = (each for each in self._open if _is_plausible(each.last, sighting))
            interval = min(able, key=lambda each: _distance(each.last, sighting), default=None)
            if interval is None:
                interval = Interval(sighting, sighting, sighting)
                self.intervals.append(interval)
                self._open.append(interval)
            else:
                interval.extend(sighting)
            found.append(interval)
        return found


def _is_plausible(before: Sighting, after: Sighting) -> bool:
    """Whether the object of a sighting can be that of one in a later frame."""
    if after.object != before.object or after.frame <= before.frame:
        return False
    growth = math.sqrt(after.box.area / before.box.area)
    reach = _JUMP + _SPEED * (after.time - before.time)
    return 1 / _GROWTH <= growth <= _GROWTH and _distance(before, after) <= reach


def _distance(before: Sighting, after: Sighting) -> float:
    """Distance of the centres, in multiples of the object's size."""
    size = math.sqrt(math.sqrt(before.box.area * after.box.area))
    return math.dist(before.box.centre, after.box.centre) / size
