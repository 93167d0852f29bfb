"""Counts objects in zones of the picture: which enter and leave, how many are inside, and for how long they were.

    catstream track walk.mp4 --box anna=120,80,64,48 --box ben=300,90,60,150 --set run.endpoint=run
    python examples/zone_counter.py run "door=300,80 420,80 420,400 300,400" "yard=0,80 200,80 200,400 0,400"

A zone is a polygon, by its corners x,y in pixels. An object is in it if the centre of its box is; it leaves once the
centre is more than 10 pixels outside, so that one that stands on the border is counted once.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import catstream
from catstream.output.events import Event, Events


class Counter:
    """Counts the objects in zones from the events of a run."""

    def __init__(self) -> None:
        self.inside: dict[str, dict[str, float]] = defaultdict(dict)  # zone -> object -> time at which it entered
        self.visits: dict[str, list[float]] = defaultdict(list)  # zone -> seconds of each visit that has ended

    def take(self, event: Event) -> None:
        """Count an event, and print it if an object enters or leaves a zone."""
        if event.track is None:  # an event of the source
            return
        name, time, objects = event.track.object, event.track.time, self.inside[event.zone]
        if event.kind == "entered":
            objects[name] = time
        elif event.kind == "left":
            self.visits[event.zone].append(time - objects.pop(name))
        else:
            return
        print(f"{time:.1f} s: {name or 'the object'} {event.kind} {event.zone}, {len(objects)} inside", flush=True)


def main(endpoint: str, *zones: str) -> None:
    """Count until the pipeline ends; each zone is NAME=X,Y X,Y X,Y ..."""
    corners = {}
    for zone in zones:
        name, _, points = zone.partition("=")
        corners[name] = tuple((float(x), float(y)) for x, y in (point.split(",") for point in points.split()))
    events, counter = Events(corners), Counter()
    with catstream.subscribe(endpoint, "tracks") as tracks:
        for track in tracks:
            for event in events.update([track]):
                counter.take(event)
    for event in events.close():
        counter.take(event)
    for name in corners:
        visits = counter.visits[name]
        print(f"{name}: {len(visits)} visits, {sum(visits):.1f} s in all")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit('usage: python zone_counter.py ENDPOINT "NAME=X,Y X,Y X,Y ..." ["NAME=X,Y X,Y X,Y ..." ...]')
    main(*sys.argv[1:])
