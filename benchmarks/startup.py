"""Seconds from the start of `catstream track` to its first track, and to the first trained model.

Cold: the kernels have to be compiled first. Warm: they are in the cache, as from the second start on.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from sequences import named
from table import Table, benchmark, command

from catstream.base.box import Box
from catstream.errors import ServiceError

CACHE = "NUMBA_CACHE_DIR"  # folder of the compiled kernels


def figures(options: argparse.Namespace) -> Iterator[Table]:
    sequence = named(options, "TLD_01_david")
    box, runs = Box(*sequence.boxes[0]), 1 if options.quick else options.runs
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for kernels in ("warm",) if options.quick else ("cold", "warm"):
            # Each cold start has an empty kernel folder of its own; the warm starts use the first of these folders.
            caches = [Path(folder, str(run) if kernels == "cold" else "0") for run in range(runs)]
            times = [start(str(sequence.path), box, {} if options.quick else {CACHE: str(cache)}) for cache in caches]
            first = [seconds for seconds, _ in times]
            learned = [seconds for _, seconds in times if seconds is not None]
            rows.append((kernels, runs, median(first), max(first), median(learned) if learned else None))
    columns = ("kernels", "runs", "first track, s", "the slowest", "first learned model, s")
    yield Table(f"From the command on, {sequence.name}", columns, rows, "medians; a real process, imports and all")


def start(source: str, box: Box, variables: dict[str, str]) -> tuple[float, float | None]:
    """Return the seconds to the first track, and to the first one with a trained model; None if the video ends before.

    The command is started with these environment variables on top of our own.
    """
    with tempfile.TemporaryDirectory() as output:
        begin = time.perf_counter()
        process = subprocess.Popen(
            [Path(sys.executable).with_name("catstream"), "track", source, "--box", str(box), "--output", output],
            env=os.environ | variables,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            first, learned = (wait(process, Path(output), version, begin) for version in (0, 1))
        finally:
            process.terminate()
            process.wait()
    if first is None:
        raise ServiceError(f"catstream track {source} --box {box} printed no track: run it in a terminal to see why")
    return first, learned


def wait(process: subprocess.Popen[bytes], output: Path, version: int, begin: float) -> float | None:
    """Return the seconds until a track with at least this model version is in the results."""
    running = True
    while running:
        running = process.poll() is None
        if any(found >= version for found in versions(next(output.glob("*.csv"), output / "none"))):
            return time.perf_counter() - begin
        time.sleep(0.002)
    return None


def versions(tracks: Path) -> list[int]:
    """Return the model version of each complete row."""
    complete = tracks.read_text().rpartition("\n")[0] if tracks.exists() else ""
    return [int(row["model_version"]) for row in csv.DictReader(complete.splitlines())]


if __name__ == "__main__":
    benchmark(figures, command(__doc__), runs=(7, "number of starts of each kind"))
