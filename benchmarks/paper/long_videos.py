"""Table 6 of the paper: a TLD video lengthened to 100,000 frames, with a fixed coreset size.

Success must not fall with the length, and time a frame and memory must stay flat. As in the paper, the video is
followed by clips of a tenth of its length, flipped, reversed in time, with other contrast and brightness, shifted,
and with noise. The real pipeline follows it; a shorter video is the beginning of a longer one. Each clip is a cut:
the object jumps.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import shared  # noqa: F401
from journey import Journey, travel
from sequences import named, scratch
from table import Table, benchmark, command

from catstream.base.settings import PRESETS, Settings
from catstream.measure.datasets import Sequence
from catstream.measure.scores import score
from catstream.video.writer import VideoWriter

#: Tracker -> mean success of the four longest TLD videos at 10, 20, 50, 75 and 100 thousand frames.
PAPER = {
    "CAT, n = 500": (0.522, 0.559, 0.578, 0.586, 0.594),
    "CAT, n = 1000": (0.606, 0.634, 0.658, 0.669, 0.673),
    "CAT, n = 1500": (0.627, 0.674, 0.697, 0.701, 0.702),
    "CAT, n = 2000": (0.685, 0.702, 0.718, 0.725, 0.726),
    "CAT, n = 2500": (0.713, 0.724, 0.736, 0.743, 0.744),
    "TLD": (0.579, 0.573, 0.569, 0.567, 0.567),
    "TGPR": (0.382, 0.368, 0.365, 0.364, 0.362),
}
LENGTHS = np.array([0.1, 0.2, 0.5, 0.75, 1.0])
_CONTRAST, _BRIGHTNESS, _SHIFT, _NOISE = 0.2, 20.0, 0.05, 4.0


def figures(options: argparse.Namespace) -> Iterator[Table]:
    frames = 40 if options.quick else options.frames
    journeys, successes = {}, []
    for name in options.videos[:1] if options.quick else options.videos:
        sequence = named(options, name)
        path, truth = lengthened(sequence, frames)
        for n in options.sizes[:1] if options.quick else options.sizes:
            settings = base_of(options).replace({"coreset.size": n, "coreset.share": 0.0})
            label = f"{sequence.name}, n = {n}"
            journey = journeys[label] = travel(str(path), truth[0], settings, watch=max(frames // 200, 1))
            ends = (LENGTHS * frames).astype(int)
            boxes = np.array(journey.boxes)
            successes.append((label, *(score(boxes[:end], truth[:end]).success for end in ends)))
        path.unlink()
    lengths = [f"{length * frames:.0f}" for length in LENGTHS]
    paper = [(f"paper: {name}", *printed) for name, printed in PAPER.items()]
    yield Table("Success", ("frames", *lengths), successes + paper, "the paper's columns: 10K, 20K, 50K, 75K and 100K")
    yield Table("Growth", ("video", *GROWTH), [(name, *growth(journey)) for name, journey in journeys.items()])


def base_of(options: argparse.Namespace) -> Settings:
    """Return all settings except n."""
    return Settings.from_values(PRESETS.get(options.preset, {}))


def lengthened(sequence: Sequence, frames: int) -> tuple[Path, np.ndarray]:
    """Lengthen a video with clips of itself; return it with the box of the object in each frame."""
    rng, images = np.random.default_rng(0), list(sequence.frames())
    height, width = images[0].shape[:2]
    clip = max(len(images) // 10, 1)
    path, truth = scratch() / f"{sequence.name}.mp4", []
    with VideoWriter(path, 25, (width, height)) as video:
        for image, box in zip(images[:frames], sequence.boxes, strict=False):
            video.write(image)
            truth.append(box)
        while len(truth) < frames:
            begin = rng.integers(len(images) - clip + 1)
            order = np.arange(begin, begin + clip)[:: rng.choice([-1, 1])]
            flip, contrast = rng.random() < 0.5, 1 + rng.uniform(-_CONTRAST, _CONTRAST)
            brightness = rng.uniform(-_BRIGHTNESS, _BRIGHTNESS)
            shift = rng.uniform(-_SHIFT, _SHIFT, 2) * (width, height)
            for number in order[: frames - len(truth)]:
                image, (x, y, w, h) = images[number], sequence.boxes[number]
                if flip:
                    image, x = image[:, ::-1], width - x - w
                place = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
                moved = cv2.warpAffine(image, place, (width, height), borderMode=cv2.BORDER_REPLICATE)
                noise = rng.standard_normal(moved.shape, np.float32) * _NOISE
                video.write((moved * contrast + brightness + noise).clip(0, 255).astype(np.uint8))
                truth.append((x + shift[0], y + shift[1], w, h))
    return path, np.array(truth)


GROWTH = (
    "ms, first tenth",
    "ms, last tenth",
    "ratio",
    "processor ms, first tenth",
    "last tenth",
    "ratio",
    "MB, first tenth",
    "MB at the end",
)


def growth(journey: Journey) -> tuple[float, ...]:
    """Return early and late medians of time per frame and processor time in milliseconds, and the memory in use."""
    tenth = max(len(journey.milliseconds) // 10, 1)
    early, late = np.median(journey.milliseconds[:tenth]), np.median(journey.milliseconds[-tenth:])
    work = [journey.work(name)[1] for name in journey.looks]
    few = max(len(work[0]) // 10, 1)
    began, ended = (sum(float(each[part].mean()) for each in work) for part in (slice(few), slice(-few, None)))
    before = sum(looks[len(looks) // 10].megabytes for looks in journey.looks.values())
    after = sum(looks[-1].megabytes for looks in journey.looks.values())
    ratio = ended / began if began else 1.0  # of a few frames, whose time is less than a tick of the clock
    return float(early), float(late), float(late / early), began, ended, ratio, before, after


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--preset", choices=PRESETS, help="preset for the settings except n (default: none)")
    benchmark(
        figures,
        parser,
        base_of,
        frames=(100_000, "frames of the longest video"),
        videos=(["TLD_06_car", "TLD_10_panda"], "names of sequences"),
        sizes=([64, 500], "n"),
    )
