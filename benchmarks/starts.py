"""The frames and boxes that runs start with: temporal and spatial robustness (TRE, SRE), and jitter.

one_pass  one-pass evaluation (OPE): the first frame with the object
temporal  temporal robustness (TRE): several frames
spatial   spatial robustness (SRE) of the CVPR2013 benchmark: 12 initial boxes, shifted or scaled
jittered  several initial boxes that differ by at most 2 %: dependence of a result on chance
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from sequences import frame_size

from catstream.base.box import Box
from catstream.errors import BoxError, VideoError
from catstream.measure.datasets import Sequence


@dataclass(frozen=True, slots=True)
class Variation:
    """A change of the initial box: shifts of its centre in widths and heights, and factors of its sides.

    name  part of the name of the run; empty for the box of the ground truth, which is not changed

    >>> Variation("right", right=0.1).applied(Box(10, 20, 30, 40))
    Box(x=13.0, y=20.0, w=30.0, h=40.0)
    """

    name: str = ""
    right: float = 0.0
    down: float = 0.0
    wider: float = 1.0
    higher: float = 1.0

    def applied(self, box: Box) -> Box:
        x, y = box.centre
        return box.scaled(self.wider, self.higher).centred(x + self.right * box.w, y + self.down * box.h)


@dataclass(frozen=True, slots=True)
class Start:
    """The frame and the box that a run starts with: a row of the ground truth, and a change of its box."""

    frame: int = 0
    variation: Variation = Variation()

    @property
    def suffix(self) -> str:
        """The end of the name of a run, after the name of its sequence: `@120`, `@left`, `@120-left`, or empty."""
        parts = [str(self.frame)] if self.frame else []
        parts += [self.variation.name] if self.variation.name else []
        return "@" + "-".join(parts) if parts else ""

    def box(self, sequence: Sequence) -> Box:
        """Return the initial box.

        A changed box that tracking cannot start with is moved until its centre is in the frame, and gets sides from 2
        pixels to twice those of the frame.
        """
        box = Box(*map(float, sequence.boxes[self.frame]))
        if not self.variation.name:
            return box
        changed, (width, height) = self.variation.applied(box), frame_size(sequence.since(self.frame))
        w, h = min(max(changed.w, 2.0), 2.0 * width), min(max(changed.h, 2.0), 2.0 * height)
        return Box(0.0, 0.0, w, h).centred(*changed.centre).with_centre_in(width, height)


FIRST = Start()
#: Chooses the starts of a sequence.
Starts = Callable[[Sequence], list[Start]]

_DIRECTIONS = {"left": (-1, 0), "right": (1, 0), "up": (0, -1), "down": (0, 1)}
_CORNERS = {"left-up": (-1, -1), "right-up": (1, -1), "left-down": (-1, 1), "right-down": (1, 1)}

#: The 12 initial boxes of the CVPR2013 benchmark: shifts by 10 % of the box, and four sizes.
SHIFTS = (
    *(Variation(name, 0.1 * x, 0.1 * y) for name, (x, y) in (_DIRECTIONS | _CORNERS).items()),
    *(Variation(f"size-{factor}", wider=factor, higher=factor) for factor in (0.8, 0.9, 1.1, 1.2)),
)

_JITTER = 0.02


def one_pass(sequence: Sequence) -> list[Start]:
    """Return one start: the first frame with the object."""
    return [Start(_first(sequence))]


def temporal(count: int) -> Starts:
    """Choose `count` evenly spaced start frames.

    If the object is absent in one, or tracking cannot start with its box, the next frame is used. It reads a frame of
    each sequence.
    """

    def starts(sequence: Sequence) -> list[Start]:
        frames = _valid(sequence)
        places = np.searchsorted(frames, np.arange(count) * len(sequence) // count)
        return [Start(frame) for frame in sorted({frames[place] for place in places if place < len(frames)})]

    return starts


def spatial(sequence: Sequence) -> list[Start]:
    """Return the first frame with the object, with each of the initial boxes in `SHIFTS`."""
    return [Start(_first(sequence), variation) for variation in SHIFTS]


def jittered(count: int) -> Starts:
    """Choose `count` boxes in the first frame with the object: that of the ground truth, and random changes of it.

    The changes are at most 2 % of the sides, and the same in each sequence and on each machine.
    """
    variations = [Variation(), *map(_jitter, range(1, count))]
    return lambda sequence: [Start(_first(sequence), variation) for variation in variations]


def _jitter(seed: int) -> Variation:
    right, down, wider, higher = np.random.default_rng(seed).uniform(-_JITTER, _JITTER, 4).tolist()
    return Variation(f"jitter-{seed}", right, down, 1 + wider, 1 + higher)


def _first(sequence: Sequence) -> int:
    return int(sequence.present.argmax())


def _valid(sequence: Sequence) -> list[int]:
    """Return the frames with a box that tracking can start with; all with the object if none has one, or none is read.

    The run then raises the error. The last frame with the object is left out: nothing but the given box would be
    measured.
    """
    present = [int(frame) for frame in np.flatnonzero(sequence.present)][:-1]
    try:
        size = frame_size(sequence.since(present[0]))
    except VideoError:
        return present
    return [frame for frame in present if _is_valid(Box(*map(float, sequence.boxes[frame])), *size)] or present


def _is_valid(box: Box, width: int, height: int) -> bool:
    try:
        box.validated(width, height)
    except BoxError:
        return False
    return True
