"""The objects that begin in a frame: one list, whether from the job, a command, a saved model or a resume."""

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
class Beginning:
    """An object that begins in a frame, or continues at the box of a command.

    result  its track and its training rows in the frame; None if it is searched for
    model   the saved model that it begins with; None without one
    """

    name: str
    result: Result | None
    model: SavedModel | None = None


class Beginnings:
    """Lets the objects of a stream begin: their detectors are ready for the frame afterwards."""

    def __init__(self, process: Process, detectors: Detectors, commands: Commands, previews: Previews) -> None:
        self._process, self._detectors, self._commands, self._previews = process, detectors, commands, previews

    def resume(self, start: Start, models: Mapping[str, Model]) -> None:
        """Continue the detectors of a process that died; the objects that cannot continue begin in a later frame."""
        for name, state in start.states.items():
            detector = self._detectors.add(name)
            detector.resume(state, models[name])
            saved = self._commands.models.get(start.desired.objects[name].model) if state.is_sought else None
            if saved is not None:
                detector.similarity = saved.similarity()

    def in_frame(self, frame: Frame, *, held: bool) -> list[Beginning]:
        """The objects that begin in a frame: at the boxes of pending commands, and all that are due.

        While the run is `held`, a frame is tracked only if there is such a box.
        """
        beginnings = self._at_boxes(frame)
        if beginnings or not held:
            beginnings += self._due(frame, {beginning.name for beginning in beginnings})
        return beginnings

    def _due(self, frame: Frame, names: set[str]) -> Iterator[Beginning]:
        """The objects whose first frame this is, or that a restarted process has to begin again, except `names`."""
        commands, detectors = self._commands, self._detectors
        for name, desired in [*commands.desired.objects.items()]:  # the samples are numbered in their order
            if name in names or (name in detectors.detectors and desired.begins != detectors.seq + 1):
                continue
            self._process.watchdog.allow()
            if not desired.model:
                pyramid = Pyramid(frame.image)
                yield Beginning(name, detectors.begin(name, pyramid, desired.box, frame.time))
            elif (saved := commands.models.get(desired.model)) is not None:
                detectors.seek(name, saved.model, saved.box, saved.similarity())
                yield Beginning(name, None, saved)
            else:
                commands.change(commands.desired.without(name))

    def _at_boxes(self, frame: Frame) -> list[Beginning]:
        """The objects of the boxes that wait; of two boxes for one name, the second waits for the next frame."""
        beginnings: dict[str, Beginning] = {}
        for command in self._commands.take_boxes():
            try:
                names = command.boxes.keys() or {object_of(command, self._commands.desired)}
                if names & beginnings.keys():
                    self._commands.boxes.append(command)
                    continue
                if command.boxes:
                    together, answered = self._together(command, frame)
                    beginnings |= together
                else:
                    (name,) = names
                    beginnings[name], answered = self._at_box(name, command, frame)
                self._commands.store_and_answer(answered)
            except (BoxError, ObjectError) as error:
                self._commands.reject(command, str(error))
        return [*beginnings.values()]

    def _together(self, command: Command, frame: Frame) -> tuple[dict[str, Beginning], Answer]:
        """Begin all objects of a command, or, after an error in one box, none of them."""
        commands, detectors = self._commands, self._detectors
        names = commands.desired.objects.keys() | command.boxes.keys()
        check_count(len(names), self._process.settings.run.max_objects)
        self._process.watchdog.allow()
        results = detectors.begin_all(command.boxes, Pyramid(frame.image), frame.time)
        for name, box in command.boxes.items():
            commands.desired = commands.desired.with_object(name, DesiredObject(box, detectors.seq + 1))
        effect = f"{listed(command.boxes)} begin in frame {detectors.seq}"
        beginnings = {name: Beginning(name, result) for name, result in results.items()}
        return beginnings, answer(command, detectors, True, effect, frame=detectors.seq)

    def _at_box(self, name: str, command: Command, frame: Frame) -> tuple[Beginning, Answer]:
        """Begin an object at the box of a command, or continue it there.

        A box that was drawn in a past picture is searched for in the frames since.
        """
        if command.box is None:
            raise BoxError("missing box: set-box needs one")
        commands, detectors, box = self._commands, self._detectors, command.box
        place, frames = f"at {box} in frame {detectors.seq}", [frame]
        if command.time is not None and (since := self._previews.since(command.time)):
            frames = [*since, frame]
            place = f"at {box} in the picture {frame.time - command.time:.1f} s before frame {detectors.seq}"
        elif command.time is not None:
            place += ", since the picture in which it was drawn is not stored any more"
        pyramids = (Pyramid(one.image) for one in frames)
        first = next(pyramids)
        check_room(name, commands.desired, self._process.settings.run.max_objects)
        self._process.watchdog.allow()
        suffix = f" {name}" if name else ""
        if continues(command, name, commands.desired, detectors):
            result = detectors.correct(name, first, box, frame.time, pyramids)
            effect = f"the same object{suffix} continues {place}"
        else:
            result = detectors.begin(name, first, box, frame.time, pyramids)
            box = (detectors.detectors[name].box or box) if len(frames) > 1 else box
            effect = f"{'another' if name in commands.desired.objects else 'the'} object{suffix} begins {place}"
            commands.desired = commands.desired.with_object(name, DesiredObject(box, detectors.seq + 1))
        return Beginning(name, result), answer(command, detectors, True, effect, name, detectors.seq)
