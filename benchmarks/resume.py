"""Kills processes of a run at random moments, and checks that the run continues without losing or repeating a row.

After a random number of new rows, one process gets SIGKILL, and is restarted by the run. At least a hundred rows later,
`catstream track` and all its processes get it, and `--resume` continues the run; this is repeated. After the last kill,
the run of a file continues to its end, and that of a live source (`--live`) for some seconds.
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
from sequences import FIRST, objects, scratch
from table import Table, benchmark, command

from catstream.base.settings import Settings
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.errors import ServiceError
from catstream.output.track_log import Log
from catstream.processes.state import CHECKPOINTS
from catstream.video.live_demo import first_box
from catstream.video.rendered import write

LIVE = "demo:1"
_REST = 200  # frames after the last kill: a fast pipeline continues until the kill takes effect
_BETWEEN = 100  # least rows from the death of one process to that of all
TRACK = [sys.executable, "-P", "-c", "from catstream.cli import main; main()", "track"]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    moments, most, rest = (1, 5, 100) if options.quick else (options.moments, options.rows, _REST)
    frames = moments * (2 * most + _BETWEEN) + rest
    place, chance = scratch(), random.Random(options.seed)
    if options.live:
        source, boxes = LIVE, {FIRST: first_box(LIVE)}
    else:
        video, truth = write(place, frames, (320, 240))
        source, boxes = str(video), objects(str(video), truth[0], options.objects)
    kept, out = place / "kept", place / "out"
    given = [word for name, box in boxes.items() for word in ("--box", f"{name}={box}")]
    begin = [source, *given, "--output", str(out), "--state", str(kept)]
    seconds, behind = [], []
    for number in range(moments):
        arguments = ["--resume", str(kept)] if number else begin
        seconds.append(watched(arguments, out, chance.randrange(most), chance))
        behind.append(newest(out) - CheckpointStore(kept / CHECKPOINTS).position()[1])
    seconds.append(watched(["--resume", str(kept)], out, rest if options.live else None))

    log = [*Log(next(out.glob("*.csv")))]
    rows = [(track.frame, track.object) for frame in log for track in frame.tracks]
    frames = max(track + 1 for track, _ in rows) if options.live else frames
    lost, twice = frames * len(boxes) - len(set(rows)), len(rows) - len(set(rows))
    stored = CheckpointStore(kept / CHECKPOINTS).load(Settings()).seq
    columns = ("killed", "frames", "objects", "rows lost", "rows twice", "messages stored", "s to a new row", "longest")
    row = (moments, frames, len(boxes), lost, twice, stored, float(np.median(seconds[1:])), max(seconds[1:]))
    learned = (float(np.median(behind)), max(behind))
    note = f"""seed {options.seed}; killed: so often one process, and so often all
s to learn again: of the video, from the checkpoint to the last row; a live source loses them"""
    yield Table("Resume", (*columns, "s to learn again", "most"), [(*row, *learned)], note)


def watched(arguments: list[str], out: Path, rows: int | None, chance: random.Random | None = None) -> float:
    """Run until a number of new rows are written, to the end if it is None; return the seconds to the first new row.

    With `chance`, kill one process, and some rows later all of them.
    """
    started, before, first = time.monotonic(), written(out), 0.0
    process = subprocess.Popen([*TRACK, *arguments], stderr=subprocess.DEVNULL)
    parent, victims = psutil.Process(process.pid), 0
    while process.poll() is None:
        new = written(out) - before
        first = first or (new and time.monotonic() - started)
        if rows is None or new <= (2 * rows + _BETWEEN if victims else rows):
            time.sleep(0.02)
        elif chance is None:
            process.terminate()
            process.wait()
            return first
        elif victims == 0:
            chance.choice(parent.children(recursive=True)).kill()
            victims = 1
        else:
            family = [parent, *parent.children(recursive=True)]
            for one in family:
                one.kill()
            process.wait()
            psutil.wait_procs(family)
            return first
    if process.returncode or chance is not None:
        raise ServiceError(f"`catstream track {' '.join(arguments)}` ended too early, with {process.returncode}")
    return first or time.monotonic() - started


def newest(out: Path) -> float:
    """Return the time of the last whole row in the results."""
    (table,) = out.glob("*.csv")
    return float(table.read_text().rpartition("\n")[0].rpartition("\n")[2].split(",")[1])


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
        live=(False, "track a live source"),
        seed=(0, "seed of the random moments"),
    )
