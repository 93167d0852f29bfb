"""Limits the lag of training behind the detector: a pure decision from the progress of the other processes."""

from __future__ import annotations

from enum import Enum

__all__ = ["Awaited", "awaited"]


class Awaited(Enum):
    """The event that the detector waits for before its next frame."""

    TAKEN = "the compressor processes the features of a frame"
    MODEL = "a model arrives that was learned from that frame"
    NOTHING = "no event: the next frame may be processed"


def awaited(due: int, taken: int, sample: int, newest: int) -> Awaited:
    """Return the event that the detector waits for.

    Parameters
    ----------
    due : seq of the newest features that the model must include by now; 0 or less if there are none yet
    taken : seq of the newest features that the compressor has processed
    sample : version of the newest sample of the features up to `due`, as far as it is known
    newest : version of the newest model that was received

    Examples
    --------
    >>> awaited(due=7, taken=6, sample=0, newest=0)
    <Awaited.TAKEN: 'the compressor processes the features of a frame'>
    >>> awaited(due=7, taken=8, sample=3, newest=3).name
    'NOTHING'
    """
    if taken < due:
        return Awaited.TAKEN
    return Awaited.MODEL if newest < sample else Awaited.NOTHING
