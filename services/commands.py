"""The effect of commands on the state of the detector's process: pure functions, see `catstream.services.core`.

A command that needs no frame is carried out at once. A box is applied to the next frame that is tracked; during a pause
of a file, to the frame that is held. Each command is answered exactly once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace as with_fields

from msgspec.structs import replace

from catstream.errors import CatstreamError, ObjectError
from catstream.messages.kinds import Answer, Command
from catstream.messages.names import UNNAMED, check_count, check_name, listed
from catstream.run.learned import check_sizes
from catstream.services.actions import Action, Conclude, SetBox
from catstream.services.core_state import STOPPED, Known, Phase, Request, State
from catstream.services.desired import DesiredObject

#: Commands whose effect does not depend on the frame at which they arrive.
_AT_ANY_FRAME = ("pause", "resume", "stop")


def carried_out(state: State, request: Request) -> tuple[State, list[Answer]]:
    """Carry out a command, or let it wait; the answer to a box follows with the next frame.

    While frames of an earlier detector are repeated, commands for objects wait: their objects begin or end with a
    message that nobody has received yet. `pause` and `stop` are answered at once, and hold after these frames. At the
    end of the stream, every command except `save` is rejected.
    """
    command = request.command
    if state.ending and command.verb != "save":
        return state, [_answer(state, command, False, f"the pipeline is ending: {state.ending}")]
    if state.is_repeating and not state.ending and command.verb not in _AT_ANY_FRAME:
        return replace(state, waiting=(*state.waiting, request)), []
    if command.verb == "set-box":
        return replace(state, boxes=(*state.boxes, command)), []
    try:
        state, answer = _VERBS[command.verb](state, request)
    except CatstreamError as error:
        return state, [_answer(state, command, False, str(error))]
    state, rejected = rejected_boxes(state, f"the pipeline is ending: {state.ending}") if state.ending else (state, [])
    return state, [answer, *rejected]


def waited(state: State) -> tuple[State, list[Answer]]:
    """Carry out the commands that have waited."""
    waiting, state = state.waiting, replace(state, waiting=())
    answers: list[Answer] = []
    for request in waiting:
        state, more = carried_out(state, request)
        answers += more
    return state, answers


def rejected_boxes(state: State, reason: str) -> tuple[State, list[Answer]]:
    """Reject the boxes that wait for a frame, because there is none."""
    return replace(state, boxes=()), [_answer(state, command, False, reason) for command in state.boxes]


def concluded(state: State, answers: list[Answer]) -> list[Action]:
    """Store the desired state, then answer. A restarted detector may need the models of frames that it repeats."""
    models = state.desired.models_since(state.seq - state.rules.window)
    models |= {request.saved.name for request in state.waiting if request.saved is not None}
    return [Conclude(tuple(answers), tuple(sorted(models)))]


def next_box(state: State) -> tuple[State, list[Action]] | None:
    """Begin the object of the first box that waits for a frame; None if there is none.

    Of two boxes for one name, the second one waits for the frame after it.
    """
    for at, command in enumerate(state.boxes):
        boxes = (*state.boxes[:at], *state.boxes[at + 1 :])
        try:
            name = _name(state, command)
            if name in state.given or command.box is None:
                continue
            if name not in state.desired.objects:
                check_count(len(state.desired.objects) + 1, state.rules.objects_most)
        except ObjectError as error:
            return replace(state, boxes=boxes), concluded(state, [_answer(state, command, False, str(error))])
        order = SetBox(name, command.box, _is_kept(state, name, command))
        command = with_fields(command, object=name, keep=order.keep)
        return replace(state, phase=Phase.BOX, boxes=boxes, box=command), [order]
    return None


def begun(state: State, command: Command, known: Known | None, error: str) -> tuple[State, list[Answer]]:
    """The state and the answer after `SetBox` was carried out; `known` is the detector, None if the box was refused."""
    if known is None or command.box is None:
        return state, [_answer(state, command, False, error)]
    name = command.object
    at, of_name = f"at {command.box} in frame {state.seq}", f" {name}" if name else ""
    if command.keep:
        effect = f"the same object{of_name} continues {at}"
    else:
        effect = f"{'another' if name in state.desired.objects else 'the'} object{of_name} begins {at}"
        state = replace(state, desired=state.desired.begun(name, DesiredObject(command.box, state.seq + 1)))
    state = replace(state, given=(*state.given, name), known=state.known | {name: known})
    return state, [_answer(state, command, True, effect, frame=state.seq)]


def _is_kept(state: State, name: str, command: Command) -> bool:
    """Whether a box is for the same object; one without a model has nothing that could be kept."""
    known, each = state.known.get(name), state.desired.objects.get(name)
    return command.keep and bool(known and known.version and each and each.begins <= state.seq)


def _pause(state: State, request: Request) -> tuple[State, Answer]:
    state = replace(state, desired=with_fields(state.desired, paused=True))
    return state, _answer(state, request.command, True, f"paused {_after(state)}")


def _resume(state: State, request: Request) -> tuple[State, Answer]:
    state = replace(state, desired=with_fields(state.desired, paused=False))
    effect = "waiting for a box" if state.desired.holds else f"resumed {_after(state)}"
    return state, _answer(state, request.command, True, effect)


def _stop(state: State, request: Request) -> tuple[State, Answer]:
    state = replace(state, desired=with_fields(state.desired, stopped=True), ending=STOPPED)
    return state, _answer(state, request.command, True, f"the stream ends {_after(state)}")


def _search(state: State, request: Request) -> tuple[State, Answer]:
    """Begin an object in the next frame: it is searched for by a saved model."""
    command, saved, seq = request.command, request.saved, state.seq
    name = _name(state, command)
    if name not in state.desired.objects:
        check_count(len(state.desired.objects) + 1, state.rules.objects_most)
    if saved is None:
        return state, _answer(state, command, False, request.error)
    desired = state.desired.begun(name, DesiredObject(saved.box, seq + 1, saved.name, saved.size))
    check_sizes({name: each.size for name, each in desired.objects.items() if each.begins > seq and each.model})
    effect = f"{listed([name])} is searched for from frame {seq} on, by model {saved.version}"
    return replace(state, desired=desired), _answer(state, command, True, effect, name)


def _forget(state: State, request: Request) -> tuple[State, Answer]:
    """Stop tracking an object from the next frame on; everything learned of it is dropped."""
    name = _tracked(state, request.command)
    state = replace(state, desired=state.desired.without(name, state.seq))
    waits = "" if state.desired.objects else ": no object is left, so the run waits for a box"
    effect = f"{listed([name])} is no longer tracked {_after(state)}{waits}"
    return state, _answer(replace(state, known={}), request.command, True, effect, name)


def _save(state: State, request: Request) -> tuple[State, Answer]:
    """Answer with the version of the model; the client writes the file."""
    name = _tracked(state, request.command)
    known = state.known.get(name)
    if known is None or not known.version:
        why = "nothing was learned of the object yet: try again once there is a model (catstream status)"
    elif known.sought:
        why = "the object of the saved model was not found yet: try again once it was"
    else:
        return state, _answer(state, request.command, True, f"model {known.version} {_after(state)}", name)
    return state, _answer(state, request.command, False, why, name)


_VERBS: dict[str, Callable[[State, Request], tuple[State, Answer]]] = {
    "pause": _pause,
    "resume": _resume,
    "stop": _stop,
    "search": _search,
    "forget": _forget,
    "save": _save,
}


def _name(state: State, command: Command) -> str:
    """The name of the object that a command is for: without a name, the object that has none, or the only one."""
    names = state.desired.objects
    if command.object or not names or UNNAMED in names:
        return check_name(command.object)
    if len(names) > 1:
        raise ObjectError(f"which object? This run has {listed(names)}: give a name")
    return next(iter(names))


def _tracked(state: State, command: Command) -> str:
    """The same; raises ObjectError if there is no such object."""
    name, names = _name(state, command), state.desired.objects
    if not names:
        raise ObjectError("no object is tracked yet: give one a box first (set-box), or a saved model (search)")
    if name not in names:
        raise ObjectError(f"there is no object {name!r}: the objects are {listed(names)}")
    return name


def _after(state: State) -> str:
    if state.is_repeating:
        return "after the last frame that was tracked before the restart"
    return f"after frame {state.seq - 1}" if state.seq else "before the first frame"


def _answer(
    state: State, command: Command, done: bool, reason: str, name: str | None = None, frame: int | None = None
) -> Answer:
    """The answer to a command for the object `name`, by default that of the command."""
    name = command.object if name is None else name
    frame = max(state.seq - 1, 0) if frame is None else frame
    known = state.known.get(name)
    box, version = (known.window.box(state.rules.context), known.version) if known is not None else (None, 0)
    return Answer(command.id, done, reason, frame, box, version, name)
