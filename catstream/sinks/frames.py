"""The tracks of a frame, in the order in which files hold them: it shows later whether a frame was written whole.

A crash can cut a file within a frame of several objects. In each frame, the objects that were not in the frame before
come first. So a last frame that has all objects of the frame before it is complete. Any other last frame may be
incomplete, and counts as not written: it is tracked again.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from itertools import groupby

from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED

#: Stands for the objects of the frame before the first one: an object without a name is written last.
FIRST = frozenset({UNNAMED})


def in_order(tracks: Mapping[str, Track], before: Container[str]) -> list[Track]:
    """Return the tracks of a frame in the order in which they are written.

    Parameters
    ----------
    before : the objects of the frame before, `FIRST` for the first frame
    """
    return sorted(tracks.values(), key=lambda track: track.object in before)


def whole_frames(tracks: Iterable[Track]) -> Iterator[list[Track]]:
    """Yield the tracks of each frame together, except for a last frame that may be incomplete."""
    before: frozenset[str] = FIRST
    waiting: list[Track] = []
    for _, frame in groupby(tracks, key=lambda track: track.frame):
        if waiting:
            yield waiting
            before = objects_of(waiting)
        waiting = list(frame)
    if waiting and before <= objects_of(waiting):
        yield waiting


def objects_of(tracks: Iterable[Track]) -> frozenset[str]:
    """Return the names of the objects."""
    return frozenset(track.object for track in tracks)
