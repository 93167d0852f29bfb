"""Limits the lag of training behind the detector: a pure decision from the progress of the other processes."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum

__all__ = ["Awaited", "awaited"]


class Awaited(Enum):
    """The event that the detector waits for before its next frame."""

    TAKEN = "the compressor processes the features of a frame"
    MODEL = "the models arrive that were learned from that frame"
    NOTHING = "no event: the next frame may be processed"


def awaited(due: int, taken: int, samples: Mapping[str, int], newest: Mapping[str, int]) -> Awaited:
    """Return the event that the detector waits for.

    Parameters
    ----------
    due : seq of the newest features that the model must include by now; 0 or less if there are none yet
    taken : seq of the newest features that the compressor has processed
    samples : version of each object's newest sample of the features up to `due`, as far as it is known
    newest : version of the newest model that was received, of each object that had begun by `due`

    Examples
    --------
    >>> awaited(due=7, taken=6, samples={}, newest={"": 0})
    <Awaited.TAKEN: 'the compressor processes the features of a frame'>
    >>> awaited(due=7, taken=8, samples={"": 3}, newest={"": 3}).name
    'NOTHING'
    """
    if taken < due:
        return Awaited.TAKEN
    behind = any(newest[name] < version for name, version in samples.items() if name in newest)
    return Awaited.MODEL if behind else Awaited.NOTHING
