"""Speed of catstream and OpenCV's trackers on the same frames, the slowest frames, and the size of image and coreset.

CSRT and KCF come with the contrib modules of OpenCV 4: pip install "catstream[peers]".
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from statistics import median
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from accuracy import TrackerRun, available, follow_from, run_all, shortened
from journey import Journey, travel
from sequences import named, rendered
from starts import FIRST
from table import Table, benchmark, command

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.coreset.forest import Forest
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.measure.datasets import Sequence
from catstream.training.trainer import Trainer

TRACKERS = ("catstream", "csrt", "kcf")
MODES = ("local", "full")
#: Frames that count as the start of a run: there are no models of many frames yet, and the trees grow fast.
START = 150
SIZES = ((320, 240), (640, 480), (960, 720), (1280, 720), (1920, 1080), (3840, 2160))
#: Width and height of the smallest box, in pixels.
TINY = 6
#: Sizes of the rendered video whose slowest frames are measured, and whether the box is tiny.
CASES = (((640, 480), False), ((640, 480), True), ((3840, 2160), False))
CORESETS = (16, 32, 64, 128, 256, 512)

#: Program of a user that prints frames per second without decoding, and a checksum of the boxes.
PROGRAM = """
import sys, time, zlib, cv2, catstream
video, tracker, check, seconds = cv2.VideoCapture(sys.argv[1]), catstream.Tracker(), 0, 0.0
tracker.init(video.read()[1], sys.argv[2])
while (read := video.read())[0]:
    begin = time.perf_counter()
    ok, box = tracker.update(read[1])
    seconds += time.perf_counter() - begin
    check = zlib.crc32(repr((ok, box)).encode(), check)
print((tracker.track.seq - 1) / seconds, check)
"""
#: Environments of the program: unchanged, and with one thread from the start.
ENVIRONMENTS = {
    "none": {},
    "OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1": {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
}


def figures(options: argparse.Namespace) -> Iterator[Table]:
    yield own_program(options)
    cases, sizes, modes, coresets, frames = CASES, SIZES, MODES, CORESETS, 300
    if options.quick:  # one run of the pipeline gives a figure for three tables
        cases, sizes, modes, coresets, frames = CASES[:1], ((640, 480),), ("local",), (Settings().coreset.size,), 8
    sequences = [one for one in shortened(options) if {one.name, "all"} & {*options.sequences}]
    journeys = [sequence_in_pipeline(sequence) for sequence in sequences]
    trackers, missing = available(TRACKERS)
    runs = run_all(sequences, trackers, Settings())
    own = [run for run in runs if run.tracker == "catstream"]
    yield beside_peers(sequences, journeys, runs, missing)
    yield frame_times(own, journeys, cases, frames)
    yield steps([named(options, "TLD_01_david")])
    rows = [
        (
            f"{width}x{height}",
            *(demo_in_pipeline(frames, (width, height), False, Settings(search={"mode": mode})).rate for mode in modes),
        )
        for width, height in sizes
    ]
    yield Table("Frames/s against the size of the image", ("pixels", *modes), rows, "three processes, with decoding")
    rows = [(n, demo_in_pipeline(frames, (640, 480), False, Settings(coreset={"size": n})).rate) for n in coresets]
    yield Table(
        "Frames/s against the size of the coreset", ("n", "640x480, local"), rows, "three processes, with decoding"
    )


def own_program(options: argparse.Namespace) -> Table:
    """Measure the Tracker in a user's program with the default environment, and with one thread from the start."""
    frames, runs = (8, 1) if options.quick else (300, 5)
    sequence = rendered(frames, (352, 288))
    box = ",".join(map(str, sequence.boxes[0].tolist()))
    command = [sys.executable, "-P", "-c", PROGRAM, str(sequence.path / "demo.mp4"), box]
    plain = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    found: dict[str, list[tuple[float, str]]] = {name: [] for name in ENVIRONMENTS}
    for _ in range(runs):  # alternating, so that other load of the machine affects both alike
        for name, variables in ENVIRONMENTS.items():
            printed = subprocess.run(
                command, env=plain | variables, capture_output=True, text=True, check=True
            ).stdout.split()
            found[name].append((float(printed[0]), printed[1]))
    rates = {name: median(rate for rate, _ in each) for name, each in found.items()}
    same = len({check for each in found.values() for _, check in each}) == 1
    rows = [(name, rate, rate / list(rates.values())[-1], "yes" if same else "no") for name, rate in rates.items()]
    columns = ("variables set", "frames/s", "ratio", "all boxes the same")
    return Table(
        "Tracker in a user's program", columns, rows, f"352x288 pixels, {frames} frames, median of {runs} runs"
    )


def beside_peers(sequences: list[Sequence], journeys: list[Journey], runs: list[TrackerRun], missing: str) -> Table:
    """Compare all trackers on one core, and the pipeline and CSRT on all cores; the first frames and the later ones."""
    found = {
        f"{tracker}, one core": together(run.seconds[1:] for run in runs if run.tracker == tracker)
        for tracker in dict.fromkeys(run.tracker for run in runs)
    }
    found["catstream, three processes"] = pipeline = together(journey.milliseconds / 1000 for journey in journeys)
    if any(run.tracker == "csrt" for run in runs):
        cv2.setNumThreads(os.cpu_count() or 1)
        found["csrt, all cores"] = together(
            follow_from("csrt", Settings(), sequence, FIRST, None).seconds[1:] for sequence in sequences
        )
        cv2.setNumThreads(1)
    own = found["catstream, one core"]
    rows = [(name, *rates, last(own) / last(rates), last(pipeline) / last(rates)) for name, rates in found.items()]
    columns = ("tracker", f"first {START} frames", "the rest", "one process by", "three processes by")
    note = f"""{len(journeys)} sequences, frames/s; one core: without decoding; three processes: with it, on all cores
by: how many times as fast catstream is in the later frames{missing}"""
    return Table("Beside OpenCV's trackers", columns, rows, note)


def last(rates: tuple[float, float | None]) -> float:
    """Return the rate of the later frames, or that of the first ones if there are no later ones."""
    first, rest = rates
    return first if rest is None else rest


def together(times: Iterable[np.ndarray]) -> tuple[float, float | None]:
    """Return the frames per second of several runs together: the first `START` frames, and the rest if there is any.

    Parameters
    ----------
    times : seconds of each frame of a run, without the first one
    """
    every = list(times)
    first, rest = (np.concatenate([each[part] for each in every]) for part in (slice(START), slice(START, None)))
    return len(first) / float(first.sum()), len(rest) / float(rest.sum()) if len(rest) else None


def frame_times(
    runs: list[TrackerRun], journeys: list[Journey], cases: Iterable[tuple[tuple[int, int], bool]], frames: int
) -> Table:
    """Return frames per second, and the median, the 99th percentile and the maximum of the time of a frame.

    Parameters
    ----------
    runs, journeys : of all sequences, in one process and in three
    cases : as `CASES`, of `frames` frames each
    """
    rows: list[tuple[object, ...]] = []
    measured = {
        "one": [spread(1000 * run.seconds[1:]) for run in runs],
        "three": [spread(journey.milliseconds) for journey in journeys],
    }
    for processes, found in measured.items():
        rates, *times = np.transpose(found)
        rows.append(("sequences, median", processes, *map(float, np.median(found, axis=0))))
        rows.append(("sequences, worst of each", processes, float(rates.min()), *(float(each.max()) for each in times)))
    for (width, height), tiny in cases:
        name = f"{width}x{height}" + (f", box of {TINY}x{TINY}" if tiny else "")
        sequence = demo((width, height), frames, tiny)
        journey = demo_in_pipeline(frames, (width, height), tiny, Settings())
        rows.append(
            (name, "one", *spread(1000 * follow_from("catstream", Settings(), sequence, FIRST, None).seconds[1:]))
        )
        rows.append((name, "three", *spread(journey.milliseconds)))
    columns = ("video", "processes", "frames/s", "p50, ms", "p99, ms", "slowest, ms", "slowest, medians")
    note = f"""{len(runs)} sequences; the rendered video has {frames} frames
one process: without decoding and the first frame; three processes: from one track to the next, with decoding"""
    return Table("Time of a frame", columns, rows, note)


def spread(milliseconds: np.ndarray) -> tuple[float, float, float, float, float]:
    """Return frames per second; median, 99th percentile and maximum; and the maximum as a multiple of the median."""
    middle, late, slowest = map(float, np.percentile(milliseconds, (50, 99, 100)))
    return 1000 / float(milliseconds.mean()), middle, late, slowest, slowest / middle


def steps(videos: list[Sequence]) -> Table:
    """Return the milliseconds per frame of decoding and of each of the three stages, run in one process."""
    columns = ("video", "detection", "decode", "detect", "compress", "train", "all")
    rows = []
    for sequence in videos:
        for mode in MODES:
            spent = np.array(costs(sequence, Settings(search={"mode": mode}))) / len(sequence)
            rows.append((sequence.name, mode, *spent.tolist(), float(spent.sum())))
    return Table("Milliseconds a frame, on one core", columns, rows, "in the pipeline the last three run side by side")


def costs(sequence: Sequence, settings: Settings) -> list[float]:
    """Total milliseconds of decoding, detection, compression and training."""
    detectors, forest, trainer = Detectors(settings), Forest(settings), Trainer(settings)
    spent = [0.0] * 4

    def timed(step: int, work: Callable[..., Any], *arguments: Any) -> Any:
        begin = perf_counter()
        answer = work(*arguments)
        spent[step] += (perf_counter() - begin) * 1000
        return answer

    frames = sequence.frames()
    for row in range(len(sequence)):
        image = timed(0, next, frames)
        frame = timed(1, Pyramid, image)
        given = {} if row else {UNNAMED: timed(1, detectors.begin, UNNAMED, frame, Box(*sequence.boxes[0]))}
        _, features = timed(1, detectors.step, frame, 0.0, given)
        for sample in timed(2, forest.take, features):
            detectors.adopt(timed(3, trainer.train, sample))
    return spent


def sequence_in_pipeline(sequence: Sequence) -> Journey:
    """Run the pipeline on a sequence."""
    part = slice(sequence.begin, sequence.begin + len(sequence))
    return travel(str(sequence.path), sequence.boxes[0], Settings(), part=part)


def demo(size: tuple[int, int], frames: int, tiny: bool) -> Sequence:
    """Return the rendered video; its box may be `tiny`, `TINY` pixels in the middle of the object."""
    sequence = rendered(frames, size)
    if not tiny:
        return sequence
    middle = Box(*map(float, sequence.boxes[0])).centre
    return replace(sequence, boxes=np.tile(Box(0, 0, TINY, TINY).centred(*middle), (len(sequence), 1)))


@cache
def demo_in_pipeline(frames: int, size: tuple[int, int], tiny: bool, settings: Settings) -> Journey:
    """Run the pipeline on the rendered video."""
    sequence = demo(size, frames, tiny)
    return travel(str(sequence.path), sequence.boxes[0], settings)


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        frames=(int, "number of frames of each sequence for the comparison (default: all)"),
        sequences=(["all"], "only these sequences for the comparison"),
    )
