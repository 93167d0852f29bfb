"""Speed of catstream and OpenCV's trackers on the same frames, and by size of the image and of the coreset.

CSRT and KCF come with the contrib modules of OpenCV 4: pip install "catstream[peers]".
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from statistics import median

import cv2
from accuracy import videos
from journey import travel
from sequences import named, rendered, video
from table import Table, command, publish
from throughput import MODES, steps

from catstream.errors import SettingsError
from catstream.evaluation.onepass import evaluate, follow
from catstream.evaluation.peers import Peer
from catstream.evaluation.runs import EvaluationRun
from catstream.settings import Settings

PEERS = ("csrt", "kcf", "mil")
SIZES = ((320, 240), (640, 480), (960, 720), (1280, 720), (1920, 1080))
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
    yield beside_peers(options)
    yield steps([named(options, "TLD_01_david")])
    sizes, modes, coresets, frames = SIZES, MODES, CORESETS, 300
    if options.quick:  # one run of the pipeline gives a figure for both tables
        sizes, modes, coresets, frames = ((640, 480),), ("local",), (Settings().coreset.size,), 8
    rows = [
        (f"{width}x{height}", *(rate(frames, (width, height), Settings(search={"mode": mode})) for mode in modes))
        for width, height in sizes
    ]
    yield Table("Frames/s against the size of the image", ("pixels", *modes), rows, "three processes, with decoding")
    rows = [(n, rate(frames, (640, 480), Settings(coreset={"size": n}))) for n in coresets]
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


def beside_peers(options: argparse.Namespace) -> Table:
    """Measure all trackers on all sequences on one core, and the pipeline and CSRT on all cores."""
    trackers, note = ["catstream"], "one core and no decoding, but for the three processes, which use all cores"
    for name in PEERS:
        try:
            Peer(name)
            trackers.append(name)
        except SettingsError as error:  # the message has the install command
            note += f"\n{error}"
    sequences = videos(options)
    journeys = [
        travel(
            video(sequence),
            sequence.boxes[0],
            Settings(),
            part=slice(sequence.begin, sequence.begin + len(sequence)),
        )
        for sequence in sequences
    ]
    pipeline = sum(len(journey.boxes) - 1 for journey in journeys) / sum(
        journey.moments[-1] - journey.moments[0] for journey in journeys
    )
    runs = evaluate(sequences, trackers, Settings())
    own = [run for run in runs if run.tracker == "catstream"]
    rows: list[tuple[object, ...]] = []
    for tracker in trackers:
        others = [run for run in runs if run.tracker == tracker]
        ratios = [ours.fps / theirs.fps for ours, theirs in zip(own, others, strict=True)]
        rate = together(others)
        rows.append((tracker, rate, together(own) / rate, median(ratios), min(ratios), pipeline / rate))
    rows.append(("catstream, three processes", pipeline, together(own) / pipeline, None, None, 1.0))
    if "csrt" in trackers:
        cv2.setNumThreads(os.cpu_count() or 1)
        threaded = together([follow("csrt", Settings(), sequence) for sequence in sequences])
        cv2.setNumThreads(1)
        rows.append(("csrt, all cores", threaded, together(own) / threaded, None, None, pipeline / threaded))
    columns = ("tracker", "frames/s", "catstream is faster by", "median sequence", "worst", "three processes by")
    return Table("Beside OpenCV's trackers", columns, rows, f"{len(own)} sequences, {note}")


def together(runs: list[EvaluationRun]) -> float:
    """Return the frames per second over all runs, without the first frame of each."""
    return sum(len(run.seconds) - 1 for run in runs) / sum(float(run.seconds[1:].sum()) for run in runs)


@cache
def rate(frames: int, size: tuple[int, int], settings: Settings) -> float:
    """Return the frames per second of the pipeline on the rendered video."""
    sequence = rendered(frames, size)
    return travel(video(sequence), sequence.boxes[0], settings).rate


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument(
        "--frames", type=int, help="number of frames of each sequence for the comparison (default: all)"
    )
    options = parser.parse_args()
    publish(figures(options), options)
