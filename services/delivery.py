"""The last messages of a process: what is done while a receiver has not stored them, and when it is given up."""

from __future__ import annotations

from enum import Enum

__all__ = ["Step", "next_step"]


class Step(Enum):
    """What to do about one message of an acknowledged channel."""

    SEND = "hand the message to the socket: its window was full"
    WAIT = "wait until the receiver has stored it"
    DONE = "the message is stored"
    GIVE_UP = "the receiver is gone"


def next_step(*, sent: bool, stored: bool, asked_seconds: float, patience_seconds: float) -> Step:
    """What to do about a message next.

    While nobody has asked the process to end, it waits for as long as a receiver takes: a receiver that died is
    restarted. A process that was asked to end has limited patience.

    Parameters
    ----------
    sent : whether the window has taken the message
    stored : whether the receiver has stored it
    asked_seconds : time since the process was asked to end, negative if it was not
    patience_seconds : how long to wait after that

    Examples
    --------
    >>> next_step(sent=True, stored=False, asked_seconds=-1, patience_seconds=0).name
    'WAIT'
    >>> next_step(sent=True, stored=False, asked_seconds=2.5, patience_seconds=0.5).name
    'GIVE_UP'
    """
    if sent and stored:
        return Step.DONE
    if asked_seconds >= patience_seconds:
        return Step.GIVE_UP
    return Step.WAIT if sent else Step.SEND
