"""The decisions of the detector's process as a state machine: without I/O, clock and frames.

    handle(state, event) -> state, actions

The process (`catstream.services.detector`) tells what has happened as an event, and carries out the actions in their
order. An event is a small value that can be written as a line of JSON: frames and models are not in it, only what a
decision depends on. A frame of a file passes through these phases, and waits in few of them:

    FRAME ─> READY ─> STEP ─> RESULTS ─> OWNER ─> FEATURES ─> TAKEN ─> MODEL ─> FRAME
             │   ^
             v   │  a command sets a box, or ends the pause
           BOX, HELD

The end of the stream passes FEATURES, TAKEN, RESULTS and OWNER in this order.

The last thousand events are kept, and are written to a file if the process crashes: see `History`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace as with_fields
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
from msgspec.structs import replace

from catstream.messages.kinds import ObjectPosition, Position
from catstream.services import actions, commands
from catstream.services.actions import Action
from catstream.services.core_state import Known, Phase, Progress, Request, State
from catstream.services.desired import DesiredObject, DesiredState
from catstream.services.timing import FEATURES_END_SECONDS, RESULTS_END_SECONDS

EARLY_SECONDS = 5.0

#: For the end to be stored, once the process was asked to end.
_END_SECONDS = {"features": FEATURES_END_SECONDS, "results": RESULTS_END_SECONDS}
_EVENTS = 1000  # that are kept

#: A state, and the actions that belong to it.
Moved = tuple[State, list[Action]]


def handle(state: State, event: Event) -> Moved:
    """Return the state after an event, and the actions of the process.

    Raises
    ------
    ValueError
        If the event cannot happen in the phase of the state.
    """
    if event.only_in and state.phase is not event.only_in:
        raise ValueError(f"{type(event).__name__} is not expected while the detector waits until {state.phase}")
    state, found = event.change(state)
    while (move := _MOVES.get(state.phase)) is not None and (moved := move(state)) is not None:
        state, more = moved
        found = [*found, *more]
    return state, found


class _Event(msgspec.Struct, frozen=True, tag=True):
    """Something that happened to the process; in JSON, the field `type` is the name of its class.

    only_in  the phase in which it can happen; None if it can happen in all
    """

    only_in: ClassVar[Phase | None] = None

    def change(self, state: State) -> Moved:
        """The state after it, and the actions."""
        raise NotImplementedError


# Before the first frame


class Subscribed(_Event, frozen=True):
    """How far subscribers are, `seconds` after the process began to wait for them.

    recorder   whether the tracks have a subscriber, which the recorder of a recorded run is: there is no time-out
    announced  whether all that had announced themselves are connected
    """

    only_in = Phase.SUBSCRIBERS
    recorder: bool
    announced: bool
    seconds: float

    def change(self, state: State) -> Moved:
        """Go on once they are connected."""
        late = not self.announced and self.seconds < EARLY_SECONDS
        if late or (state.rules.recorded and not self.recorder):
            return state, []
        return replace(state, phase=Phase.POSITIONS if state.rules.resumes else Phase.FRAME), []


class Positions(_Event, frozen=True):
    """All receivers have answered: the compressor, then the owner of the run if it has one."""

    only_in = Phase.POSITIONS
    positions: tuple[Position, ...]

    def change(self, state: State) -> Moved:
        """Continue after the last message that every receiver has stored, once compressor and trainer agree.

        Either of them may have been restarted too, and then repeats its last steps: the models of the compressor's
        newest samples have to arrive first.

        An object that was forgotten after that message continues too, until the message after which it was forgotten.
        If nothing was learned of any object yet, the start is before the first frame of the first of them. If nothing
        was learned of one of several objects, which takes long with the paper's first tracker only, it begins again
        where it was last. An object of a saved model, of which the compressor has no trees, begins again too.
        """
        desired, learned = state.desired, self.positions[0].objects
        last = min(self.positions, key=lambda each: each.seq)
        versions = {name: each.version for name, each in learned.items() if each.version}
        objects, seq = _continuing(last, desired), last.seq
        if any(state.arrived.get(name) != versions[name] for name in versions.keys() & objects.keys()):
            return state, []
        for name, each in objects.items():
            if each.model and name not in learned and desired.objects.get(name) == each:
                desired = desired.begun(name, with_fields(each, begins=seq + 1))
        objects = _continuing(last, desired)
        if not versions:
            seq, objects = min((each.begins - 1 for each in objects.values()), default=seq), {}
        found: dict[str, Action] = {}
        for name, each in objects.items():
            at = last.objects.get(name, ObjectPosition())
            if name in versions and (at.detector is not None or at.box is not None):
                model = each.model if at.detector is not None and at.detector.is_sought else ""
                found[name] = actions.Continue(name, at, each.box, each.begins - 1, model)
            elif not each.model and desired.objects.get(name) == each:
                desired = desired.begun(name, DesiredObject(at.box or each.box, seq + 1))
        for name, each in desired.objects_at(seq).items():
            if each.model and name not in found:  # its state is not known: it counts as not found
                found[name] = actions.Seek(name, each.model, each.begins - 1, again=True)
        repeats = max(position.seq for position in self.positions)
        state = replace(state, phase=Phase.RESUME, seq=seq, desired=desired, repeats=repeats, arrived={})
        return state, [*found.values(), actions.Resume(seq, self.positions), *commands.concluded(state, [])]


def _continuing(last: Position, desired: DesiredState) -> dict[str, DesiredObject]:
    """The objects that began before a position and have a track in the message after it, in the order of the trees."""
    objects = {name: each for name, each in desired.objects_at(last.seq + 1).items() if each.begins <= last.seq}
    return {name: objects[name] for name in last.objects if name in objects} | objects


class Resumed(_Event, frozen=True):
    """The detectors that there are after `Resume`, by name."""

    only_in = Phase.RESUME
    known: dict[str, Known]

    def change(self, state: State) -> Moved:
        """Wait for the first frame."""
        return replace(state, phase=Phase.FRAME, known=self.known), []


# A frame


class Frame(_Event, frozen=True):
    """The next frame of the source."""

    only_in = Phase.FRAME
    number: int
    live: bool

    def change(self, state: State) -> Moved:
        """Decide what becomes of it, unless an earlier detector has tracked it."""
        ready = state if self.number < state.seq else replace(state, phase=Phase.READY, live=self.live)
        return ready, []


def _ready(state: State) -> Moved:
    """Boxes of commands come first; then the frame is tracked, held or left out."""
    if (moved := commands.next_box(state)) is not None:
        return moved
    if state.given or not (state.end_reason or state.holds):
        return replace(state, phase=Phase.STEP), _orders(state)
    if state.end_reason:
        return replace(state, phase=Phase.FRAME), []
    shown: list[Action] = [actions.Show(held=True)]  # the other objects, while a box is drawn
    if state.live:
        return replace(state, phase=Phase.FRAME, skipped=state.skipped + 1), shown
    return replace(state, phase=Phase.HELD), shown


def _held(state: State) -> Moved | None:
    return (replace(state, phase=Phase.READY), []) if state.boxes or state.end_reason or not state.holds else None


class Begun(_Event, frozen=True):
    """`SetBox` was carried out: the detector after it, or the error for which the box was refused."""

    only_in = Phase.BOX
    known: Known | None = None
    error: str = ""

    def change(self, state: State) -> Moved:
        """Answer the command."""
        if (command := state.box) is None:
            return state, []
        state = replace(state, phase=Phase.READY, box=None)
        state, answers = commands.begun(state, command, self.known, self.error)
        return state, commands.concluded(state, answers)


def _orders(state: State) -> list[Action]:
    """What becomes of each object in the next message, which may be repeated after a restart.

    The objects begin in the order in which they began before, in which the samples are numbered.
    """
    seq, known = state.seq + 1, state.known
    objects = state.desired.objects_at(seq)
    orders = _forgotten(state, objects)
    for name, each in objects.items():
        if each.begins == seq and name not in state.given:
            begins = actions.Seek(name, each.model, state.seq) if each.model else actions.Begin(name, each.box)
            orders.append(begins)
        elif name not in known:  # it was forgotten later: see `Positions`
            orders.append(actions.Miss(name))
    return [*orders, actions.Step()]


def _forgotten(state: State, objects: Mapping[str, DesiredObject]) -> list[Action]:
    """Remove the detectors of all objects but these."""
    return [actions.Forget(name) for name in state.known if name not in objects]


class Stepped(_Event, frozen=True):
    """`Step` was carried out: the detectors after the frame, by name, and how far the receivers are."""

    only_in = Phase.STEP
    known: dict[str, Known]
    progress: Progress

    def change(self, state: State) -> Moved:
        """Send the message; carry out the commands that have waited for the end of the repeated frames."""
        seq, known, progress = state.seq + 1, self.known, self.progress
        state = replace(state, phase=Phase.RESULTS, seq=seq, known=known, given=(), progress=progress)
        if not state.waiting or state.is_repeating:
            return state, []
        state, answers = commands.waited(state)
        return state, commands.concluded(state, answers)


def _results(state: State) -> Moved | None:
    """Send the tracks to the owner of the run, if it has one."""
    if not state.rules.owned:
        return replace(state, phase=Phase.OWNER), []
    return _sent(state, Phase.OWNER, "results", state.progress.owner_limit)


def _owner(state: State) -> Moved | None:
    """In lockstep the owner is never behind: after a crash, all continue after the same message."""
    owned, lockstep, progress = state.rules.owned, state.rules.lockstep, state.progress
    if state.over:
        return None if owned and _is_owed(state, "results", progress.owner_acknowledged) else _finished(state)
    if owned and lockstep and progress.owner_taken < state.seq and state.stopping < 0:
        return None
    return replace(state, phase=Phase.FEATURES), []


def _features(state: State) -> Moved | None:
    """Send the features to the compressor."""
    moved = _sent(state, Phase.TAKEN, "features", state.progress.limit)
    if moved is not None and not state.over:
        moved[1].append(actions.Show())
    return moved


def _sent(state: State, phase: Phase, channel: actions.DataChannel, limit: int) -> Moved | None:
    """Send a message if there is room in the window; give it up if the process is to end; otherwise wait.

    There is no other time-out, as a receiver that died is restarted. Nothing follows a message that was given up: no
    receiver takes a message before the one before it.
    """
    seq = state.seq + state.over
    if channel in state.given_up:
        return replace(state, phase=phase), []
    if seq <= limit:
        return replace(state, phase=phase), [actions.Send(channel, seq, state.over)]
    if state.stopping >= (_END_SECONDS[channel] if state.over else 0.0):
        state = replace(state, phase=phase, given_up=(*state.given_up, channel))
        return state, [actions.GiveUp(channel, seq)]
    return None


def _is_owed(state: State, channel: actions.DataChannel, acknowledged: int) -> bool:
    """Whether the end of the stream was not acknowledged yet, and is still awaited."""
    is_open = channel not in state.given_up and acknowledged <= state.seq
    return is_open and state.stopping < _END_SECONDS[channel]


def _taken(state: State) -> Moved | None:
    """Limit the lag of training behind the detector; a live source does not wait. The end has to be stored."""
    if state.over:
        owed = _is_owed(state, "features", state.progress.acknowledged)
        return None if owed else (replace(state, phase=Phase.RESULTS), [])
    if state.live or state.end_reason:
        return replace(state, phase=Phase.FRAME), []
    if min(state.progress.taken, state.progress.due) < state.due:
        return None
    return replace(state, phase=Phase.MODEL), []


def _model(state: State) -> Moved | None:
    """The same for the models; the compressor may be restarted meanwhile."""
    due, progress, known = state.due, state.progress, state.known
    if state.end_reason or progress.taken < due:
        return replace(state, phase=Phase.TAKEN), []
    for name, version in progress.samples.items():
        if (each := known.get(name)) is not None and each.began < due and each.newest < version:
            return None
    return replace(state, phase=Phase.FRAME), []


class ModelArrived(_Event, frozen=True):
    """A model arrived; `known` is the detector that has adopted it, None before the positions agree."""

    name: str
    version: int
    known: Known | None = None

    def change(self, state: State) -> Moved:
        """Note its version."""
        if self.known is None:
            return replace(state, arrived=state.arrived | {self.name: self.version}), []
        return replace(state, known=state.known | {self.name: self.known}), []


class Progressed(_Event, frozen=True):
    """Receivers have processed or acknowledged messages."""

    progress: Progress

    def change(self, state: State) -> Moved:
        """Note how far they are."""
        return replace(state, progress=self.progress), []


class SourceLost(_Event, frozen=True):
    """A live source was lost, so that no frame arrives until it is back."""

    def change(self, state: State) -> Moved:
        """Reject the boxes that wait for a frame."""
        why = "the source is lost, so there is no frame for a box: try again once it is back"
        state, answers = commands.rejected_boxes(state, why)
        return state, commands.concluded(state, answers)


class Commanded(_Event, frozen=True):
    """A command arrived."""

    request: Request

    def change(self, state: State) -> Moved:
        """Carry it out, or let it wait."""
        state, answers = commands.carried_out(state, self.request)
        if not answers:
            return state, []
        forgotten = _forgotten(state, state.desired.objects_at(state.seq + 1))
        known = {name: each for name, each in state.known.items() if actions.Forget(name) not in forgotten}
        return replace(state, known=known), [*forgotten, *commands.concluded(state, answers)]


# The end


class Stopping(_Event, frozen=True):
    """A signal asked the process to end, `seconds` ago."""

    seconds: float

    def change(self, state: State) -> Moved:
        """End at once before the first frame, as no message was sent yet."""
        early = state.phase in (Phase.SUBSCRIBERS, Phase.POSITIONS)
        return replace(state, stopping=self.seconds, phase=Phase.ENDED if early else state.phase), []


class Ended(_Event, frozen=True):
    """The source has ended, or nothing more is read from it."""

    only_in = Phase.FRAME
    reason: str
    failed: bool = False

    def change(self, state: State) -> Moved:
        """Send the end of the stream, to the owner once it is stored: the end of the tracks says so."""
        reason = self.reason if self.failed else state.end_reason or self.reason
        state, rejected = commands.rejected_boxes(state, f"the pipeline is ending: {reason}")
        state, answers = commands.waited(replace(state, phase=Phase.FEATURES, ending=reason, over=True))
        return state, commands.concluded(state, [*rejected, *answers])


def _finished(state: State) -> Moved:
    """Clear the command `stop` at the end of the run, so that a resumed detector does not stop at once."""
    state = replace(state, phase=Phase.ENDED, desired=with_fields(state.desired, stopped=False))
    return state, [*commands.concluded(state, []), actions.Finish()]


#: What ends a phase that needs no event of its own; the result is None as long as the phase goes on.
_MOVES: dict[Phase, Callable[[State], Moved | None]] = {
    Phase.READY: _ready,
    Phase.HELD: _held,
    Phase.RESULTS: _results,
    Phase.OWNER: _owner,
    Phase.FEATURES: _features,
    Phase.TAKEN: _taken,
    Phase.MODEL: _model,
}

Event = (
    Subscribed
    | Positions
    | Resumed
    | Frame
    | Begun
    | Stepped
    | ModelArrived
    | Progressed
    | SourceLost
    | Commanded
    | Stopping
    | Ended
)


class _Line(msgspec.Struct):
    """A line of the file of events; the actions are plain values of JSON."""

    event: Event
    actions: list[Any]


_ENCODER = msgspec.json.Encoder(enc_hook=np.ndarray.tolist)  # the arrays in the states of detectors


class History:
    """A state, and the last events that led to it.

    Parameters
    ----------
    state : before the first event
    """

    def __init__(self, state: State) -> None:
        self.state = state
        self._last: deque[tuple[State, Event, list[Action]]] = deque(maxlen=_EVENTS)

    def handle(self, event: Event) -> list[Action]:
        """Change the state by an event; return the actions of the process."""
        found: list[Action] = []
        self._last.append((self.state, event, found))  # before an error
        self.state, more = handle(self.state, event)
        found += more
        return found

    def write(self, file: Path) -> None:
        """Write the state before the last events, then each of them with its actions: a line of JSON each."""
        before = self._last[0][0] if self._last else self.state
        lines = [before, *(_Line(event, found) for _, event, found in self._last)]
        file.write_bytes(b"".join(_ENCODER.encode(line) + b"\n" for line in lines))

    @staticmethod
    def read(file: Path) -> tuple[State, list[tuple[Event, list[Any]]]]:
        """Read what `write` wrote: with `handle`, the same events lead to the same actions."""
        first, *lines = file.read_bytes().splitlines()
        read = [msgspec.json.decode(line, type=_Line, dec_hook=lambda _, numbers: np.array(numbers)) for line in lines]
        return msgspec.json.decode(first, type=State), [(line.event, line.actions) for line in read]
