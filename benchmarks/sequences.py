"""The sequences of the benchmarks: annotated sequences from a folder, or rendered ones."""

from __future__ import annotations

import argparse
import atexit
import json
import tempfile
from contextlib import closing, suppress
from functools import cache
from pathlib import Path

import numpy as np

from catstream.base.box import Box
from catstream.errors import BoxError, VideoError
from catstream.measure.datasets import Sequence, find_sequences
from catstream.tracker import Tracker
from catstream.video.rendered import FRAMES, SIZE, Sprite, cut_out_dahlia, load_photograph, write
from catstream.video.source import open_source

_GROUPS = json.loads(Path(__file__).with_name("groups.json").read_text(encoding="utf-8"))
#: The defaults were tuned on the first twenty, so their measures are biased upwards. Those of the check list are no
#: longer used for tuning; three of the fifteen are in the tuning set too, twelve never were.
TUNED, CHECK = frozenset(_GROUPS["tuned"]), frozenset(_GROUPS["check"])

FIRST = "first"  #: name of the object of a sequence, if it is one of several

_QUICK_FRAMES = 8
_SIDE = 40  # width and height of a patch, pixels
_MARGIN = 8  # from the edge of the frame, pixels


@cache
def scratch() -> Path:
    """Return a temporary folder that is removed when the benchmark ends."""
    folder = tempfile.TemporaryDirectory(prefix="catstream-benchmark-")
    atexit.register(folder.cleanup)
    return Path(folder.name)


@cache
def rendered(frames: int, size: tuple[int, int] = SIZE) -> Sequence:
    """Render the demo video, in any length and size, as a sequence."""
    folder = scratch() / f"demo-{size[0]}x{size[1]}-{frames}"
    write(folder, frames, size)
    return find_sequences(folder)[0]


def sequences(options: argparse.Namespace, prefix: str = "") -> list[Sequence]:
    """Return the sequences in the data folder whose names begin with `prefix`; with --quick, a few rendered frames.

    Raises
    ------
    VideoError
        If there is none.
    """
    if options.quick:
        return [rendered(_QUICK_FRAMES, (320, 240))]
    if not options.data.is_dir():
        raise VideoError(
            f"there are no sequences at {options.data}: pass a folder of sequences with --data, or use --quick"
        )
    found = [sequence for sequence in find_sequences(options.data) if sequence.name.startswith(prefix)]
    if not found:
        raise VideoError(f"there is no sequence {prefix}* in {options.data}: pass another --data")
    return found


def frame_size(sequence: Sequence) -> tuple[int, int]:
    """Read the first frame, and return its width and height."""
    with closing(sequence.frames()) as frames:
        height, width = next(frames).shape[:2]
    return width, height


def named(options: argparse.Namespace, name: str) -> Sequence:
    """Return the sequence of this name, or the demo video if there is no data folder."""
    if options.quick or options.data.is_dir():
        return sequences(options, name)[0]
    return rendered(FRAMES, (320, 240))


@cache
def _dahlia() -> Sprite:
    return cut_out_dahlia(load_photograph("flower"))


def painted(
    background: np.ndarray, place: tuple[float, ...], light: float, rng: np.random.Generator
) -> tuple[np.ndarray, Box]:
    """Return a picture of a dahlia before a background, all of it in a light and with noise; and the dahlia's box.

    place : x, y, size in pixels, and angle in degrees
    """
    dahlia, image = _dahlia(), background.astype(np.float32)
    matrix = dahlia.transform(np.array(place), np.eye(2, 3))
    dahlia.paint(image, matrix, np.ones(image.shape[:2], np.float32))
    noisy = image * light + rng.normal(scale=3.0, size=image.shape)
    return noisy.clip(0, 255).astype(np.uint8), dahlia.box(matrix)


def objects(source: str, box: Box, count: int) -> dict[str, Box]:
    """Return the boxes of several objects in the first frame of a source, by name: that of its object, and patches.

    Raises
    ------
    VideoError
        If there are not enough patches beside the object that can be tracked.
    """
    with open_source(source) as frames:
        image = next(iter(frames)).image
    height, width = image.shape[:2]
    found = {FIRST: box}
    for y in range(_MARGIN, height - _SIDE, _SIDE):
        for x in range(_MARGIN, width - _SIDE, _SIDE):
            patch = Box(float(x), float(y), float(_SIDE), float(_SIDE))
            if len(found) < count and not patch.overlap(box):
                with suppress(BoxError):  # it looks like its surroundings
                    Tracker().init(image, patch)
                    found[f"patch-{len(found)}"] = patch
    if len(found) < count:
        raise VideoError(f"the first image of {source} has room for {len(found)} objects, not {count}: give fewer")
    return found
