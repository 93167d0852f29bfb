"""The state on which the decisions of the detector's process depend: see `catstream.services.core`."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from catstream.box import Box, Window
from catstream.messages.kinds import Command
from catstream.services.desired import DesiredState

#: The reason of a stream's end, if a command stopped it.
STOPPED = "it was stopped by a command"

_ALL = 1 << 62  # greater than the number of any message


class Phase(StrEnum):
    """What the process waits for."""

    SUBSCRIBERS = "the recorder and announced subscribers connect"
    POSITIONS = "the receivers answer, and the models arrive that belong to the answers"
    RESUME = "the detectors continue at the position"
    FRAME = "the next frame arrives"
    READY = "nothing: it is decided what becomes of the frame"
    BOX = "an object begins at the box of a command"
    HELD = "a command ends the pause, or sets a box in the frame that is held"
    STEP = "the objects are found in the frame"
    RESULTS = "there is room in the window of the results"
    OWNER = "the owner of the run has processed the tracks, or received the end"
    FEATURES = "there is room in the window of the features"
    TAKEN = "the compressor processes the features of a frame, or stores the end"
    MODEL = "the models arrive that were learned from that frame"
    ENDED = "nothing more"


class Rules(msgspec.Struct, frozen=True):
    """What holds for the whole run.

    window        messages of a channel that may be sent and not acknowledged, at most
    lag_frames    frames that the detector may be ahead of its models; 0 in lockstep
    lockstep      whether the owner of the run is never behind
    objects_most  the most objects at a time
    context       size of a window, in boxes of its object
    owned         whether there is an owner that receives the tracks
    recorded      whether the recorder has to subscribe before the first frame
    resumes       whether the process continues after an earlier one
    """

    window: int
    lag_frames: int
    lockstep: bool
    objects_most: int
    context: float
    owned: bool = False
    recorded: bool = False
    resumes: bool = False


class Known(msgspec.Struct, frozen=True):
    """The detector of an object.

    version  of its model, 0 before the first
    newest   newest version that arrived, in use or not
    began    number of the object's first frame
    sought   whether the object of a saved model was not found yet
    window   where the object was last
    """

    version: int
    newest: int
    began: int
    sought: bool
    window: Window


class Progress(msgspec.Struct, frozen=True):
    """The progress of the receivers.

    acknowledged  newest message of the features that is acknowledged; `taken`: that is processed; `limit`: that may be
                  sent, as there is room in the window
    owner_...     the same of the results
    samples       version of each object's newest sample of the features up to message `due`
    """

    acknowledged: int = 0
    taken: int = 0
    limit: int = 0
    owner_acknowledged: int = 0
    owner_taken: int = 0
    owner_limit: int = 0
    due: int = 0
    samples: dict[str, int] = {}


class Saved(msgspec.Struct, frozen=True):
    """A saved model: its name in `catstream.services.model_files`, its last box, its version, its size in bytes."""

    name: str
    box: Box
    version: int
    size: int


class Request(msgspec.Struct, frozen=True):
    """A command. Its saved model is not part of it: `saved` describes it, or `error` says why it cannot be used."""

    command: Command
    saved: Saved | None = None
    error: str = ""


class State(msgspec.Struct, frozen=True):
    """All that a decision depends on.

    seq       number of the last message; the next frame has the same number
    desired   the objects, paused, stopped: kept on disk
    repeats   number of the last message of an earlier detector: commands and pauses apply after it
    live      whether the source is live
    skipped   frames that were not tracked because the run was paused or waited for a box
    known     the detectors, by the names of their objects
    given     the objects whose boxes commands have set in the present frame
    boxes     commands that wait for a frame
    box       the one of them that is carried out, with the name of its object, and `keep` only if that can be kept
    waiting   commands that wait until all frames of an earlier detector are repeated
    progress  of the receivers
    arrived   version of the newest model of each object, before the positions agree
    given_up  the channels on which a message was given up
    ending    reason for which no more frames are tracked; empty while frames are tracked
    over      whether only the end of the stream is sent
    stopping  seconds since a signal asked the process to end; negative if none has
    """

    rules: Rules
    phase: Phase = Phase.SUBSCRIBERS
    seq: int = 0
    desired: DesiredState = DesiredState()
    repeats: int = 0
    live: bool = False
    skipped: int = 0
    known: dict[str, Known] = {}
    given: tuple[str, ...] = ()
    boxes: tuple[Command, ...] = ()
    box: Command | None = None
    waiting: tuple[Request, ...] = ()
    progress: Progress = Progress()
    arrived: dict[str, int] = {}
    given_up: tuple[str, ...] = ()
    ending: str = ""
    over: bool = False
    stopping: float = -1.0

    @classmethod
    def at_start(cls, rules: Rules, desired: DesiredState) -> State:
        """The state before the first event."""
        repeats, ending = _ALL if rules.resumes else 0, STOPPED if desired.stopped else ""
        return cls(rules, desired=desired, repeats=repeats, ending=ending)

    @property
    def end_reason(self) -> str:
        """Reason for which no more frames are tracked, also if it is a signal; empty while frames are tracked.

        The frames of an earlier detector are repeated before a stream is stopped: its end has to follow the last
        message that any receiver has.
        """
        if self.stopping >= 0:
            return "it was stopped"
        return "" if self.is_repeating else self.ending

    @property
    def is_repeating(self) -> bool:
        """Whether an earlier detector has sent the next message already."""
        return self.seq < self.repeats

    @property
    def holds(self) -> bool:
        """Whether no frames are tracked, because the run is paused or waits for a box."""
        return self.desired.holds and not self.is_repeating

    @property
    def due(self) -> int:
        """The newest features that the models must include by now; 0 or less if there are none yet."""
        return self.seq - self.rules.lag_frames
