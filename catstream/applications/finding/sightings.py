"""The result for a file: sightings of objects, and intervals, the sightings of one object that follow one another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from catstream.box import Box


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
class FileResult:
    """The result for one file so far, step by step.

    A sighting continues the interval of its object if that ended a short time ago, wherever in the frame it is: a model
    is of one object, so its intervals never overlap.

    file         path of the video, the image or the folder
    signature    of the file when it was searched, see `File.signature`
    gap_seconds  longest time between two sightings of an interval
    frames       number of its frames, None if unknown
    position     frame of the last step, None before the first one
    time         time of the last step in seconds
    complete     whether the file was searched to its end, or to its damage
    problems     reasons for what could not be read
    sightings    in the order of the frames
    intervals    of all objects, in the order of their first sighting
    """

    file: str
    signature: list[int]
    gap_seconds: float
    frames: int | None = None
    position: int | None = None
    time: float = 0.0
    complete: bool = False
    problems: list[str] = field(default_factory=list)
    sightings: list[Sighting] = field(default_factory=list)
    intervals: list[Interval] = field(default_factory=list)
    _newest: dict[str, Interval] = field(default_factory=dict)  # of each object

    def add(self, position: int, time: float, sightings: Iterable[Sighting]) -> list[Interval]:
        """Add a step; returns the interval of each sighting."""
        self.position, self.time = position, time
        found: list[Interval] = []
        for sighting in sightings:
            self.sightings.append(sighting)
            interval = self._newest.get(sighting.object)
            if interval is None or sighting.time - interval.last.time > self.gap_seconds:
                interval = self._newest[sighting.object] = Interval(sighting, sighting, sighting)
                self.intervals.append(interval)
            else:
                interval.extend(sighting)
            found.append(interval)
        return found
