"""Shows a running pipeline in the Rerun viewer: pictures, box, score, state and model version of each object.

    pip install ".[rerun]"
    catstream track walk.mp4 --box 120,80,64,48 --set run.endpoint=run
    python examples/rerun_subscriber.py run
    python examples/rerun_subscriber.py run --save walk.rrd

The viewer is a window. On a machine without a display, --save writes a file for the viewer.
"""

from __future__ import annotations

import argparse
import asyncio

import cv2
import numpy as np
import rerun as rr

import catstream


async def show_tracks(endpoint: str) -> None:
    """Log each track."""
    count = 0
    states: dict[str, str] = {}
    with catstream.subscribe(endpoint, "tracks") as tracks:
        async for track in tracks:
            count += 1
            below = f"/{track.object}" if track.object else ""  # an object with a name has entities of its own
            rr.set_time("frame", sequence=track.frame)
            rr.set_time("video", duration=track.time)
            if track.box is None:
                rr.log(f"camera/object{below}", rr.Clear(recursive=False))
            else:
                labels = [track.object or track.state]
                box = rr.Boxes2D(array=[track.box], array_format=rr.Box2DFormat.XYWH, labels=labels)
                rr.log(f"camera/object{below}", box)
            rr.log(f"score{below}", rr.Scalars(track.score))
            rr.log(f"model{below}", rr.Scalars(track.model_version))
            if track.state != states.get(track.object):
                rr.log(f"state{below}", rr.TextLog(track.state))
                states[track.object] = track.state
        print(f"{count} tracks, {tracks.losses()}: {tracks.end.reason if tracks.end else 'no end'}")


async def show_pictures(endpoint: str) -> None:
    """Log the newest picture several times per second, scaled to the size of its frame."""
    with catstream.subscribe(endpoint, "previews") as previews:
        async for preview in previews:
            picture = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_COLOR)
            if picture is None:
                continue
            rr.set_time("frame", sequence=preview.frame)
            rr.log("camera", rr.Image(cv2.resize(picture, (preview.width, preview.height)), "BGR").compress())


async def main() -> None:
    """Subscribe until the pipeline ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("endpoint", nargs="?", default="", help="endpoint of the pipeline; not needed if only one runs")
    parser.add_argument("--save", metavar="FILE", help="write an .rrd file instead of opening a window")
    options = parser.parse_args()
    rr.init("catstream", spawn=not options.save)
    if options.save:
        rr.save(options.save)
    await asyncio.gather(show_tracks(options.endpoint), show_pictures(options.endpoint))


if __name__ == "__main__":
    asyncio.run(main())
