"""The starts of the runs over a sequence: their frames, and the boxes that the tracker is given.

one_pass  one-pass evaluation (OPE): one run from the first box of the ground truth
temporal  temporal robustness (TRE): runs from several frames
spatial   spatial robustness (SRE) of the CVPR2013 benchmark: 12 first boxes, shifted or scaled
jittered  several first boxes that differ by at most 2 %: dependence of a result on chance
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from catstream.applications.evaluation.datasets import Sequence
from catstream.box import Box
from catstream.errors import BoxError, VideoError


@dataclass(frozen=True, slots=True)
class Variation:
    """A change of the first box, relative to its size; the default leaves it as it is.

    name     part of the name of the run; empty for the box of the ground truth
    right    shift of the centre, in widths
    down     shift of the centre, in heights
    wider    factor of the width
    higher   factor of the height

    >>> Variation("right", right=0.1).applied(Box(10, 20, 30, 40))
    Box(x=13.0, y=20.0, w=30.0, h=40.0)
    """

    name: str = ""
    right: float = 0.0
    down: float = 0.0
    wider: float = 1.0
    higher: float = 1.0

    def applied(self, box: Box) -> Box:
        """Return the changed box."""
        x, y = box.centre
        return box.scaled(self.wider, self.higher).centred(x + self.right * box.w, y + self.down * box.h)


@dataclass(frozen=True, slots=True)
class Start:
    """The frame and the box that a run starts with.

    frame      row of the ground truth
    variation  change of the box in this row
    """

    frame: int = 0
    variation: Variation = Variation()

    @property
    def suffix(self) -> str:
        """The end of the name of a run, after the name of its sequence: `@120`, `@left`, `@120-left`, or empty."""
        parts = [str(self.frame)] if self.frame else []
        parts += [self.variation.name] if self.variation.name else []
        return "@" + "-".join(parts) if parts else ""

    def box(self, sequence: Sequence, size: tuple[int, int] | None = None) -> Box:
        """Return the first box.

        size : width and height of the frame; a changed box that tracking cannot start with there is moved until its
            centre is in the frame, and gets sides from 2 pixels to twice those of the frame; None: the box is not moved
        """
        box = Box(*map(float, sequence.boxes[self.frame]))
        if not self.variation.name:
            return box
        changed = self.variation.applied(box)
        return changed if size is None else _startable(changed, *size)


#: The first frame, with the box of the ground truth.
FIRST = Start()

#: Chooses the starts of a sequence.
Starts = Callable[[Sequence], list[Start]]

_DIRECTIONS = {"left": (-1, 0), "right": (1, 0), "up": (0, -1), "down": (0, 1)}
_CORNERS = {"left-up": (-1, -1), "right-up": (1, -1), "left-down": (-1, 1), "right-down": (1, 1)}

#: The 12 first boxes of the CVPR2013 benchmark: shifts by 10 % of the box, and four sizes.
SHIFTS = (
    *(Variation(name, 0.1 * x, 0.1 * y) for name, (x, y) in (_DIRECTIONS | _CORNERS).items()),
    *(Variation(f"size-{factor}", wider=factor, higher=factor) for factor in (0.8, 0.9, 1.1, 1.2)),
)

_JITTER = 0.02


def choose_starts(frames: int | None = None, boxes: int | None = None, *, shifts: bool = False) -> Starts:
    """Return the starts for `--starts FRAMES`, `--jitter BOXES` or `--shifts`; without any of them, those of OPE."""
    if shifts:
        return spatial
    if boxes is not None:
        return jittered(boxes)
    return one_pass if frames is None else temporal(frames)


def one_pass(sequence: Sequence) -> list[Start]:
    """Return one start: the first frame with the object."""
    return [Start(_present(sequence)[0])]


def temporal(count: int) -> Starts:
    """Choose `count` evenly spaced start frames.

    If the object is absent in one, or its box is one that tracking cannot start with, for example with its centre
    outside the frame, the next frame is used. Reads a frame of each sequence.
    """

    def starts(sequence: Sequence) -> list[Start]:
        frames = _valid(sequence)
        places = np.searchsorted(frames, np.arange(count) * len(sequence) // count)
        return [Start(frame) for frame in sorted({frames[place] for place in places if place < len(frames)})]

    return starts


def spatial(sequence: Sequence) -> list[Start]:
    """Return the first frame with the object, with each of the first boxes in `SHIFTS`."""
    return [Start(_present(sequence)[0], variation) for variation in SHIFTS]


def jittered(count: int) -> Starts:
    """Choose `count` first boxes in the first frame with the object.

    The first is that of the ground truth. The centre and the sides of the others are changed by up to 2 % of the sides;
    the changes are random, and the same in each sequence and on each machine.
    """
    variations = [Variation(), *map(_jitter, range(1, count))]

    def starts(sequence: Sequence) -> list[Start]:
        return [Start(_present(sequence)[0], variation) for variation in variations]

    return starts


def _jitter(seed: int) -> Variation:
    right, down, wider, higher = np.random.default_rng(seed).uniform(-_JITTER, _JITTER, 4).tolist()
    return Variation(f"jitter-{seed}", right, down, 1 + wider, 1 + higher)


def _present(sequence: Sequence) -> list[int]:
    """Return the frames with the object."""
    return [int(frame) for frame in np.flatnonzero(np.isfinite(sequence.boxes).all(axis=1))]


def _valid(sequence: Sequence) -> list[int]:
    """Return the frames with a box that `Box.validated` accepts; all with the object if none has one, or none is read.

    The run then raises the error.
    """
    present = _present(sequence)
    try:
        size = sequence.size(present[0])
    except VideoError:
        return present
    return [frame for frame in present if _is_valid(Start(frame).box(sequence), *size)] or present


def _is_valid(box: Box, width: int, height: int) -> bool:
    try:
        box.validated(width, height)
    except BoxError:
        return False
    return True


def _startable(box: Box, width: int, height: int) -> Box:
    """Return the nearest box that `Box.validated` accepts in a frame of this size."""
    x, y = box.centre
    w, h = min(max(box.w, 2.0), 2.0 * width), min(max(box.h, 2.0), 2.0 * height)
    return Box(0.0, 0.0, w, h).centred(x, y).with_centre_in(width, height)
