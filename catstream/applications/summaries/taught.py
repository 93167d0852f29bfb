"""Selects the frames of a run that taught the tracker most, spread over time.

A frame teaches what the coreset does not contain yet: its value is the energy of the object's rows R of the frame
outside the span of the object's coreset before it, ||R (I - P)||^2 / ||R||^2, with P the projection on that span. It is
1 in the first frame, and near 0 while the object looks as it did before.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from catstream.box import Box
from catstream.compression.reduce import energy, reduce
from catstream.compression.tree import REDUCTIONS, CoresetTree
from catstream.errors import SettingsError
from catstream.messages.heads import APPEARANCE
from catstream.messages.kinds import Features
from catstream.numerics.arrays import Bool, Float32
from catstream.settings import CoresetSettings

_WEAK = 1e-3  # length of a direction, as a share of the longest one, below which it is left out of the span


@dataclass(frozen=True, slots=True)
class TaughtFrame:
    """A frame from which an object was learned.

    frame, time  number of the frame, and its seconds in the video
    box          the object's box
    novelty      share of the energy of its rows outside the span of the coreset before it
    """

    frame: int
    time: float
    box: Box | None
    novelty: float


class Novelty:
    """Measures the energy of new rows outside the span of a coreset tree, and inserts them into the tree.

    >>> novelty = Novelty(CoresetTree(size=4))
    >>> [novelty.of(np.array([row], np.float32)) for row in ([1, 0, 0], [2, 0, 0], [1, 1, 0])]
    [1.0, 0.0, 0.5]
    """

    def __init__(self, tree: CoresetTree) -> None:
        self._tree = tree
        self._span: Float32 | None = None  # orthonormal rows; None before the first row

    def of(self, rows: np.ndarray) -> float:
        """Return the share of the energy of some rows outside the span, and insert them."""
        outside = rows if self._span is None else rows - (rows @ self._span.T) @ self._span
        leaves = self._tree.leaves
        self._tree.insert(rows)
        if self._span is None or self._tree.leaves > leaves:  # a reduction has dropped directions
            self._span = _orthonormal(np.vstack([*(node.rows for node in self._tree.nodes), self._tree.pending]), 1.0)
        else:
            longest = np.sqrt(max(energy(rows) / len(rows), 1e-30))
            self._span = np.vstack([self._span, _orthonormal(outside, longest)])
        return min(energy(outside) / max(energy(rows), 1e-30), 1.0)


def taught_frames(features: Iterable[Features], settings: CoresetSettings) -> dict[str, list[TaughtFrame]]:
    """Measure each frame that taught something of an object, in order; return the frames of each object by its name.

    If another object begins under a name, the frames of the one before are left out.

    Parameters
    ----------
    settings : of the coreset trees
    """
    frames: dict[str, list[TaughtFrame]] = {}
    novelties: dict[str, Novelty] = {}
    for message in features:
        for name, part in message.objects.items():
            if part.begins or name not in novelties:
                frames[name], novelties[name] = [], Novelty(REDUCTIONS[settings.reduction](settings.size))
            if (training := part.training.get(APPEARANCE)) is not None:
                of_object: Bool = training.labels == 1
                new = novelties[name].of(training.rows[of_object])
                frames[name].append(TaughtFrame(message.frame, message.time, part.box, new))
    return frames


def most_taught(frames: list[TaughtFrame], k: int) -> list[TaughtFrame]:
    """Select the k frames with the largest novelty that are spread over the run, in order of time.

    Of n frames, two that are selected have at least n / (2k) - 1 others between them, so that there is always room.

    Raises
    ------
    SettingsError
        If there are fewer than k frames.
    """
    if len(frames) < k:
        raise SettingsError(f"{k} frames cannot be selected: {len(frames)} frames taught something, give a smaller k")
    apart = len(frames) // (2 * k)
    chosen: list[int] = []
    for place in sorted(range(len(frames)), key=lambda place: -frames[place].novelty):
        if len(chosen) < k and all(abs(place - other) >= apart for other in chosen):
            chosen.append(place)
    return [frames[place] for place in sorted(chosen)]


def _orthonormal(rows: np.ndarray, longest: float) -> Float32:
    """Orthonormal rows that span the strong directions of `rows`."""
    directions = reduce(np.asarray(rows, np.float32), len(rows))
    lengths = np.sqrt(np.sum(directions**2, axis=1))
    strong = lengths > _WEAK * max(longest, lengths[0])
    unit: Float32 = directions[strong] / lengths[strong, None]
    return unit
