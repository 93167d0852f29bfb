"""Tracks several objects in a video, and prints when two of them meet and part.

    python examples/several_objects.py walk.mp4 anna=120,80,64,48 ben=300,90,60,150

Two objects meet if their boxes overlap.
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import combinations

import catstream


def main(source: str, *objects: str) -> None:
    """Track the objects, each given as NAME=X,Y,W,H in the first frame."""
    boxes = dict(each.split("=") for each in objects)
    present: Counter[str] = Counter()
    together: set[tuple[str, str]] = set()
    with catstream.Pipeline(source, boxes) as pipeline:
        frame = -1
        for frame, tracks in enumerate(pipeline.by_frame()):
            found = {name: track.box for name, track in tracks.items() if track.box is not None}
            present.update(found.keys())
            for pair in combinations(boxes, 2):
                meet = all(name in found for name in pair) and found[pair[0]].overlap(found[pair[1]]) > 0
                if meet != (pair in together):
                    together ^= {pair}
                    print(f"frame {frame}: {' and '.join(pair)} {'meet' if meet else 'part'}", flush=True)
    for name in boxes:
        print(f"{name}: present in {present[name]} of {frame + 1} frames")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python several_objects.py SOURCE NAME=X,Y,W,H [NAME=X,Y,W,H ...]")
    main(*sys.argv[1:])
