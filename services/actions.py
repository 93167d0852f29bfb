"""The actions of the detector's process, as its core orders them: see `catstream.services.core`.

An action is a small value that can be written as JSON. Some are answered by an event, as it says there.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from catstream.box import Box
from catstream.messages.kinds import Answer, ObjectPosition, Position

#: The two channels on which no message is lost.
DataChannel = Literal["features", "results"]


class Action(msgspec.Struct, frozen=True, tag=True):
    """Immutable; in JSON, its field `type` is the name of its class."""


class Continue(Action, frozen=True):
    """Continue the detector of an object, with the newest model.

    at     its state, or its last box
    first  first box of the object, in frame `began`
    model  name of the saved model by which the object is still searched for; empty if it is not
    """

    name: str
    at: ObjectPosition
    first: Box
    began: int
    model: str = ""


class Resume(Action, frozen=True):
    """Continue all channels after message `seq`; the receivers are at these positions. Answered by `Resumed`."""

    seq: int
    positions: tuple[Position, ...]


class SetBox(Action, frozen=True):
    """Begin an object in the present frame at the box of a command, or continue it there. Answered by `Begun`."""

    name: str
    box: Box
    keep: bool


class Forget(Action, frozen=True):
    """Remove the detector of an object."""

    name: str


class Begin(Action, frozen=True):
    """Begin an object at its box in the present frame."""

    name: str
    box: Box


class Seek(Action, frozen=True):
    """Search for the object of a saved model from frame `began` on.

    again  whether an earlier detector has begun to, so that newer models may have arrived
    """

    name: str
    model: str
    began: int
    again: bool = False


class Miss(Action, frozen=True):
    """Report an object as absent in the present frame: it was forgotten later, and its state is not known."""

    name: str


class Step(Action, frozen=True):
    """Find all objects in the present frame, and publish their tracks and features. Answered by `Stepped`."""


class Send(Action, frozen=True):
    """Send a message, or the end of the stream, to a receiver; there is room in its window."""

    channel: DataChannel
    seq: int
    end: bool = False


class GiveUp(Action, frozen=True):
    """Log that a message was not sent: the process is to end, and the receiver did not answer in time."""

    channel: DataChannel
    seq: int


class Show(Action, frozen=True):
    """Show a preview of the present frame; of one that is held, with the tracks of the frame before it."""

    held: bool = False


class Conclude(Action, frozen=True):
    """Store the desired state, and the saved models of these names and no others; then answer commands."""

    answers: tuple[Answer, ...]
    models: tuple[str, ...]


class Finish(Action, frozen=True):
    """Send the end of the stream to all subscribers, and the health for the last time."""
