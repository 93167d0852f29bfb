"""How far the detector may be ahead of learning: pure decisions over the progress of the other processes."""

from __future__ import annotations

from enum import Enum

__all__ = ["Awaited", "awaited"]


class Awaited(Enum):
    """The event that the detector waits for before it takes its next frame."""

    TAKEN = "the compressor receives the features of a frame"
    MODEL = "a model arrives that was learned from that frame"
    NOTHING = "the next frame may be taken"


def awaited(due: int, taken: int, sample: int, newest: int) -> Awaited:
    """What the detector waits for.

    Parameters
    ----------
    due : seq of the newest features that have to be learned from by now, 0 or less if there are none yet
    taken : seq of the newest features that the compressor has taken
    sample : version of the newest sample that the features up to `due` led to, as far as it is known
    newest : version of the newest model that arrived

    Examples
    --------
    >>> awaited(due=7, taken=6, sample=0, newest=0)
    <Awaited.TAKEN: 'the compressor receives the features of a frame'>
    >>> awaited(due=7, taken=8, sample=3, newest=3).name
    'NOTHING'
    """
    if taken < due:
        return Awaited.TAKEN
    return Awaited.MODEL if newest < sample else Awaited.NOTHING
