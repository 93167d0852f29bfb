"""Initializes objects in a frame, from the job, a command, a saved model or the state of a resumed run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from catstream.base.names import check_count
from catstream.base.text import listed
from catstream.client.saved_model import SavedModel
from catstream.detection.detector import Result
from catstream.detection.objects import Detectors
from catstream.errors import BoxError, ObjectError
from catstream.features.pyramid import Pyramid
from catstream.processes.commands import Commands
from catstream.processes.control_commands import answer, check_room, continues, object_of
from catstream.processes.decisions import DesiredObject, Start
from catstream.processes.outputs import Previews
from catstream.processes.process import Process
from catstream.video.frames import Frame
from catstream.wire.messages import Answer, Command, Model


@dataclass(frozen=True, slots=True, eq=False)
class Initialized:
    """An object that begins in a frame, or continues at the box of a command.

    result  track and training rows in the frame; None if the object is searched for
    model   saved model with which the object begins, or None
    """

    name: str
    result: Result | None
    model: SavedModel | None = None


class Initializer:
    """Initializes the detectors of a stream's objects."""

    def __init__(self, process: Process, detectors: Detectors, commands: Commands, previews: Previews) -> None:
        self._process, self._detectors, self._commands, self._previews = process, detectors, commands, previews

    def resume(self, start: Start, models: Mapping[str, Model]) -> None:
        """Restore the detectors of a process that died; objects without a state begin again in a later frame."""
        for name, state in start.states.items():
            detector = self._detectors.add(name)
            detector.resume(state, models[name])
            saved = self._commands.models.get(start.desired.objects[name].model) if state.is_searched else None
            if saved is not None:
                detector.similarity = saved.similarity()

    def in_frame(self, frame: Frame, *, suspended: bool) -> list[Initialized]:
        """Initialize the objects that begin in a frame: by the boxes of pending commands, and by the desired state.

        While the run is `suspended`, a frame is tracked only if there is such a box.
        """
        objects = self._at_boxes(frame)
        if objects or not suspended:
            objects += self._desired(frame, {item.name for item in objects})
        return objects

    def _desired(self, frame: Frame, names: set[str]) -> Iterator[Initialized]:
        """Initialize the desired objects, except `names`, that begin in this frame or have lost their detector."""
        commands, detectors = self._commands, self._detectors
        for name, desired in [*commands.desired.objects.items()]:  # in the order of the samples' versions
            if name in names or (name in detectors.detectors and desired.begins != detectors.seq + 1):
                continue
            self._process.watchdog.allow()
            if not desired.model:
                pyramid = Pyramid(frame.image)
                yield Initialized(name, detectors.begin(name, pyramid, desired.box, frame.time))
            elif (saved := commands.models.get(desired.model)) is not None:
                detectors.seek(name, saved.model, saved.box, saved.similarity())
                yield Initialized(name, None, saved)
            else:
                commands.change(commands.desired.without(name))

    def _at_boxes(self, frame: Frame) -> list[Initialized]:
        """Initialize the objects of pending boxes; a second box for the same name waits for the next frame."""
        objects: dict[str, Initialized] = {}
        for command in self._commands.take_boxes():
            try:
                names = command.boxes.keys() or {object_of(command, self._commands.desired)}
                if names & objects.keys():
                    self._commands.boxes.append(command)
                    continue
                if command.boxes:
                    batch, answered = self._at_all_boxes(command, frame)
                    objects |= batch
                else:
                    (name,) = names
                    objects[name], answered = self._at_box(name, command, frame)
                self._commands.store_and_answer(answered)
            except (BoxError, ObjectError) as error:
                self._commands.reject(command, str(error))
        return [*objects.values()]

    def _at_all_boxes(self, command: Command, frame: Frame) -> tuple[dict[str, Initialized], Answer]:
        """Initialize all objects of a command; an error in one box rejects all of them."""
        commands, detectors = self._commands, self._detectors
        names = commands.desired.objects.keys() | command.boxes.keys()
        check_count(len(names), self._process.settings.run.max_objects)
        self._process.watchdog.allow()
        results = detectors.begin_all(command.boxes, Pyramid(frame.image), frame.time)
        for name, box in command.boxes.items():
            commands.desired = commands.desired.with_object(name, DesiredObject(box, detectors.seq + 1))
        effect = f"{listed(command.boxes)} begin in frame {detectors.seq}"
        objects = {name: Initialized(name, result) for name, result in results.items()}
        return objects, answer(command, detectors, True, effect, frame=detectors.seq)

    def _at_box(self, name: str, command: Command, frame: Frame) -> tuple[Initialized, Answer]:
        """Initialize an object at the box of a command, or continue it there.

        If the box was drawn in an earlier preview, the object is tracked through the frames since.
        """
        if command.box is None:
            raise BoxError("missing box: set-box needs one")
        commands, detectors, box = self._commands, self._detectors, command.box
        # Step 1: the frame of the box, and the frames from it to this one.
        position, frames = f"at {box} in frame {detectors.seq}", [frame]
        if command.time is not None and (since := self._previews.since(command.time)):
            frames = [*since, frame]
            position = f"at {box} in the picture {frame.time - command.time:.1f} s before frame {detectors.seq}"
        elif command.time is not None:
            position += ", because the picture in which it was drawn is no longer stored"
        pyramids = (Pyramid(item.image) for item in frames)
        first = next(pyramids)
        # Step 2: continue the same object, or begin a new one.
        check_room(name, commands.desired, self._process.settings.run.max_objects)
        self._process.watchdog.allow()
        suffix = f" {name}" if name else ""
        if continues(command, name, commands.desired, detectors):
            result = detectors.correct(name, first, box, frame.time, pyramids)
            effect = f"the same object{suffix} continues {position}"
        else:
            result = detectors.begin(name, first, box, frame.time, pyramids)
            box = (detectors.detectors[name].box or box) if len(frames) > 1 else box
            effect = f"{'another' if name in commands.desired.objects else 'the'} object{suffix} begins {position}"
            commands.desired = commands.desired.with_object(name, DesiredObject(box, detectors.seq + 1))
        return Initialized(name, result), answer(command, detectors, True, effect, name, detectors.seq)
