"""Delivery of one message on an acknowledged channel: a pure decision whether to send, wait or give up."""

from __future__ import annotations

from enum import Enum

__all__ = ["Step", "next_step"]


class Step(Enum):
    """The next step in the delivery of a message."""

    SEND = "try to send the message again: the window was full"
    WAIT = "wait until the receiver has stored it"
    DONE = "the message is stored"
    GIVE_UP = "the time-out is over"


def next_step(*, sent: bool, stored: bool, seconds_since_stop: float, patience_seconds: float) -> Step:
    """Return the next step in the delivery of a message.

    A process waits for a receiver without a time-out, as a receiver that died is restarted. Only after the process was
    asked to end, there is a time-out.

    Parameters
    ----------
    sent : whether the message was sent, so that it is in the window
    stored : whether the receiver has stored it
    seconds_since_stop : time since the process was asked to end, negative if it was not
    patience_seconds : time-out, from that moment

    Examples
    --------
    >>> next_step(sent=True, stored=False, seconds_since_stop=-1, patience_seconds=0).name
    'WAIT'
    >>> next_step(sent=True, stored=False, seconds_since_stop=2.5, patience_seconds=0.5).name
    'GIVE_UP'
    """
    if sent and stored:
        return Step.DONE
    if seconds_since_stop >= patience_seconds:
        return Step.GIVE_UP
    return Step.WAIT if sent else Step.SEND
