"""Kills all processes of a run at random moments, as a power cut does, and checks that --resume continues the run.

After a random number of new rows, `catstream track` and all its processes get SIGKILL, and `--resume` continues the
run; this is repeated. After the last kill, the run continues to its end.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
from sequences import objects, scratch
from table import Table, benchmark, command

from catstream.base.settings import Settings
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.errors import ServiceError
from catstream.jobs.state import CHECKPOINTS
from catstream.sinks.track_log import Log
from catstream.video.rendered import write

_REST = 200  # frames after the last kill: a fast pipeline continues until the kill takes effect
TRACK = [sys.executable, "-P", "-c", "from catstream.cli import main; main()", "track"]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    moments, most, rest = (1, 5, 100) if options.quick else (options.moments, options.rows, _REST)
    frames = moments * most + rest
    place, chance = scratch(), random.Random(options.seed)
    video, truth = write(place, frames, (320, 240))
    boxes = objects(str(video), truth[0], options.objects)
    kept, out = place / "kept", place / "out"
    given = [word for name, box in boxes.items() for word in ("--box", f"{name}={box}")]
    begin = [str(video), *given, "--output", str(out), "--state", str(kept)]
    resumed = ["--resume", str(kept)]
    watched(begin, out, chance.randrange(most))
    seconds = [watched(resumed, out, chance.randrange(most)) for _ in range(moments - 1)]
    seconds.append(watched(resumed, out, None))

    log = Log(out / f"{video.stem}.csv").frames()
    rows = [(track.frame, track.object) for frame in log for track in frame.tracks]
    lost, twice = frames * len(boxes) - len(set(rows)), len(rows) - len(set(rows))
    stored = CheckpointStore(kept / CHECKPOINTS).load(Settings()).seq
    columns = ("killed", "frames", "objects", "rows lost", "rows twice", "messages stored", "s to a new row", "longest")
    row = (moments, frames, len(boxes), lost, twice, stored)
    yield Table("Resume", columns, [(*row, float(np.median(seconds)), max(seconds))], f"seed {options.seed}")


def watched(arguments: list[str], out: Path, rows: int | None) -> float:
    """Run until a number of new rows are written, then kill the process and its children; if None, run to the end.

    Returns seconds to the first new row.
    """
    started, before, first = time.monotonic(), written(out), 0.0
    process = subprocess.Popen([*TRACK, *arguments], stderr=subprocess.DEVNULL)
    while process.poll() is None:
        new = written(out) - before
        first = first or (new and time.monotonic() - started)
        if rows is not None and new > rows:
            family = [psutil.Process(process.pid), *psutil.Process(process.pid).children()]
            for one in family:
                one.kill()
            process.wait()
            psutil.wait_procs(family)
            return first
        time.sleep(0.02)
    if process.returncode or rows is not None:
        raise ServiceError(f"`catstream track {' '.join(arguments)}` ended too early, with {process.returncode}")
    return first or time.monotonic() - started


def written(out: Path) -> int:
    """Return the number of rows in the results."""
    return sum(max(table.read_text().count("\n") - 1, 0) for table in out.glob("*.csv"))


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        moments=(20, "number of kills"),
        rows=(40, "maximum number of new rows before a kill"),
        objects=(1, "number of objects"),
        seed=(0, "seed of the random moments"),
    )
