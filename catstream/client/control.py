"""Send commands to a running pipeline: set a box, search for an object, forget one, pause, resume, save, stop.

A command is resent until it is answered, and is executed once.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from types import MappingProxyType
from uuid import uuid4

from catstream.base.box import Box
from catstream.base.clock import STEP_SECONDS, RunningClock
from catstream.base.names import UNNAMED, boxes_by_name, check_name
from catstream.client.saved_model import SavedModel
from catstream.errors import CommandRejectedError, ServiceError, SilenceError
from catstream.wire.channels import CONTROL, SAVED_MODELS
from catstream.wire.commands import ANSWER_SECONDS, Requester
from catstream.wire.discovery import source_at
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import Answer, Command, ModelFile, Verb
from catstream.wire.newest import Subscriber


class Control(AbstractContextManager["Control"]):
    """Sends commands to one running pipeline, from one thread at a time; close it, or use it in a `with`.

    In each command, `object` is the name of an object; without a name, the only object is meant.

    `catstream.control` makes one, and documents the parameters.

    Attributes
    ----------
    endpoint : Endpoint
        Endpoint of the pipeline.
    timeout : float
        Seconds to wait for the answer to a command.

    Raises
    ------
    CommandRejectedError
        From each command, if the pipeline does not execute it.
    SilenceError
        From each command, if no answer arrives in time; the command may still be executed later.
    ServiceError
        From each command, if these keys do not have the role "control".
    ObjectError
        From each command, if the name of the object is not valid.
    """

    def __init__(self, endpoint: Endpoint, *, timeout: float = ANSWER_SECONDS) -> None:
        self.endpoint, self.timeout = endpoint, timeout
        self._commands = Requester[Command, Answer](CONTROL, endpoint)

    @property
    def source(self) -> str:
        """Source that the pipeline tracks; empty if it is unknown here."""
        return source_at(self.endpoint)

    def set_box(
        self, box: str | Iterable[float], object: str = UNNAMED, *, keep: bool = False, time: float | None = None
    ) -> Answer:
        """Set the box of an object in the next frame that is tracked: x, y, w, h in pixels.

        During a pause this is the frame at which a file is paused, or the next frame of a live source; the pipeline
        tracks it and stays paused.

        A new name adds an object. An object that has this name is replaced, and its model is dropped; with `keep`, the
        box corrects the position of the same object.

        For a box that was drawn in a preview of a live source, `time` is the time of the `Preview`, at most five
        seconds old. The object is tracked from there to the next frame. The frames are stored for this while a client
        receives previews, up to 256 MiB; a box of an older preview applies to the next frame.
        """
        return self.execute("set-box", object, box=Box.parse(box), keep=keep, time=time)

    def set_boxes(self, boxes: Mapping[str, str | Iterable[float]]) -> Answer:
        """Set the boxes of several objects, by name, in the next frame that is tracked: as `set_box`, but in one frame.

        If one box is invalid, no object is added.
        """
        return self.execute("set-box", boxes=boxes_by_name(boxes))

    def search(self, model: SavedModel | str | os.PathLike[str], object: str = UNNAMED) -> Answer:
        """Search for the object of a saved model from the next frame on.

        The model, or its file on this machine, is sent to the pipeline, which stores a copy. The object is absent until
        it is found in the whole frame, and training continues from the saved model. An object that has this name is
        replaced, and its model is dropped.
        ServiceError or ProtocolError if the file cannot be read, or is not a saved model.
        """
        saved = model if isinstance(model, SavedModel) else SavedModel.load(model)
        return self.execute("search", object, model=saved.to_bytes())

    def forget(self, object: str = UNNAMED) -> Answer:
        """Stop tracking an object, and drop its model and coreset trees.

        The other objects continue. Without any object, the run waits for a box, as during a pause.
        """
        return self.execute("forget", object)

    def pause(self, seconds: float | None = None) -> Answer:
        """Stop processing frames; the frames of a live source are counted as skipped.

        The pause lasts until `resume`. With `seconds`, it ends that long after the last such command: if a program that
        repeats the command dies, the run continues. `seconds=0` ends only a pause with a limit.
        """
        return self.execute("pause", seconds=seconds)

    def resume(self) -> Answer:
        """Continue processing frames."""
        return self.execute("resume")

    def save(self, path: str | os.PathLike[str], object: str = UNNAMED) -> Answer:
        """Save the model and the coreset trees of an object to a local file, which `catstream.SavedModel` reads.

        ServiceError if the file cannot be written.
        """
        answer = self.execute("save", object)
        saved = self._newest(answer.object, answer.version)
        saved.save(path)
        return replace(answer, version=saved.model.version)

    def stop(self) -> Answer:
        """End the run as if the source had ended: all trees and models are stored first."""
        return self.execute("stop")

    def execute(
        self,
        verb: Verb,
        object: str = UNNAMED,
        *,
        box: Box | None = None,
        keep: bool = False,
        model: bytes | None = None,
        seconds: float | None = None,
        time: float | None = None,
        boxes: Mapping[str, Box] = MappingProxyType({}),
    ) -> Answer:
        """Send any command, and wait for its answer; the parameters are the fields of a `Command` of the protocol."""
        for one in (*boxes.values(), *([] if box is None else [box])):
            one.checked()
        for name, number in (("seconds", seconds), ("time", time)):
            if number is not None and not (math.isfinite(number) and number >= 0):
                raise ServiceError(f"{name} must be a finite number and not negative (got {number})")
        command = Command(uuid4().hex, verb, box, keep, check_name(object), model, seconds, time, dict(boxes))
        if (answer := self._commands.ask(command, self.timeout)) is None:
            raise SilenceError(
                f"no answer to {verb} from {self.endpoint} within {self.timeout:g} s: "
                f"{self.endpoint.hint()} Check it with catstream status"
            )
        if not answer.done:
            raise CommandRejectedError(f"{verb}: {answer.reason}")
        return answer

    def close(self) -> None:
        """Disconnect; the pipeline continues."""
        self._commands.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _newest(self, name: str, version: int) -> SavedModel:
        """Return the saved model of an object, of this version or a later one."""
        clock = RunningClock()
        with Subscriber(SAVED_MODELS, self.endpoint, ModelFile, about=name) as saved:
            while (remaining := self.timeout - clock()) > 0:
                message = saved.receive(min(remaining, STEP_SECONDS))
                if message is not None and message.version >= version:
                    return SavedModel.from_bytes(message.file, f"the saved model from {self.endpoint}")
        raise SilenceError(
            f"no coreset trees arrived from {self.endpoint} within {self.timeout:g} s: "
            "check the pipeline with catstream status"
        )
