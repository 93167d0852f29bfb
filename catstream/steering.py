"""Steer a running pipeline: another object, a pause, what was learned, the end.

    import catstream

    with catstream.control("run") as pipeline:
        pipeline.set_box((120, 80, 64, 48))

Each command is asked again until it is answered, and carried out once.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from time import monotonic
from typing import Self
from uuid import uuid4

from catstream.box import Box
from catstream.errors import RefusedError, SilenceError
from catstream.learned import Learned
from catstream.messages import Answer, Command, Model, Sample, Verb
from catstream.wire.endpoint import find
from catstream.wire.sockets import Requester, Subscriber

__all__ = ["Control", "control"]


class Control:
    """Sends commands to one running pipeline; close it, or use it in a `with`. Any number of programs may have one.

    Attributes
    ----------
    endpoint : str
        Where it is attached.
    source : str
        The source that the pipeline follows, empty if that is not known here.
    timeout : float
        Seconds that a command may take.

    Raises
    ------
    RefusedError
        From each command, if the pipeline does not carry it out; says why.
    SilenceError
        From each command, if no answer came in time; one that is on its way may still be carried out.
    ServiceError
        From each command, if the pipeline does not let these keys steer.
    """

    def __init__(self, endpoint: str = "", *, timeout: float = 5.0, keys: str = "", source: str = "") -> None:
        self._place = find(endpoint, keys, source)
        self.endpoint, self.source, self.timeout = str(self._place), self._place.source, timeout
        self._commands = Requester("control", self._place)

    def set_box(self, box: str | Iterable[float], *, keep: bool = False) -> Answer:
        """Say where the object is in the newest frame: x, y, w, h in pixels.

        It is another object, and what was learned of the one before is forgotten; with `keep`
        it is the same one, found again for the tracker. A paused pipeline follows this frame, and stays paused.
        """
        return self._ask("set-box", Box.parse(box), keep)

    def pause(self) -> Answer:
        """Stop taking frames; those of a live source pass by and are counted as skipped."""
        return self._ask("pause")

    def resume(self) -> Answer:
        """Take frames again."""
        return self._ask("resume")

    def save(self, path: str | os.PathLike[str]) -> Answer:
        """Write what was learned of the object to a file of this machine, whole or not at all: see `Learned`.

        The pipeline writes nothing: the file is made here, of its newest model and sample.

        Raises
        ------
        ServiceError
            Where the file cannot be written.
        """
        answer = self._ask("save")
        if answer.box is None:
            raise RefusedError("save: the object was not seen yet: ask again once it was")
        model, sample = self._newest(answer.version)
        Learned(model, sample, answer.box).save(path)
        return replace(answer, version=model.version)

    def stop(self) -> Answer:
        """End the stream as if the source had come to its end: all that was learned is stored first."""
        return self._ask("stop")

    def close(self) -> None:
        """Let go; the pipeline goes on."""
        self._commands.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _newest(self, version: int) -> tuple[Model, Sample]:
        """The newest model, at least of this version, and the sample that it was learned from."""
        model, samples, deadline = None, dict[int, Sample](), monotonic() + self.timeout
        with Subscriber("models", self._place) as models, Subscriber("samples", self._place) as newest:
            while monotonic() < deadline:
                samples |= {sample.version: sample for sample in newest.waiting() if isinstance(sample, Sample)}
                model = models.receive(0.05) or model
                if model is not None and model.version >= version and model.version in samples:
                    return model, samples[model.version]
        raise SilenceError(
            f"no model and its sample came from {self.endpoint} within {self.timeout:g} s: "
            "ask how it is (catstream status)"
        )

    def _ask(self, verb: Verb, box: Box | None = None, keep: bool = False) -> Answer:
        answer = self._commands.ask(Command(uuid4().hex, verb, box, keep), self.timeout)
        if answer is None:
            raise SilenceError(
                f"nothing at {self.endpoint} answered {verb} within {self.timeout:g} s: is a pipeline running there, "
                "and does it go on (catstream status)?"
            )
        if not answer.done:
            raise RefusedError(f"{verb}: {answer.reason}")
        return answer


def control(endpoint: str = "", *, timeout: float = 5.0, keys: str = "", source: str = "") -> Control:
    """Attach to a running pipeline, to steer it.

    Parameters
    ----------
    endpoint : str
        Where it runs, as the setting `run.endpoint` says it. Empty for the only pipeline of this user.
    timeout : float
        Seconds that a command may take.
    keys : str
        Folder of the keys of this client, if the pipeline asks for some; they must be allowed to steer.
    source : that the pipeline follows, instead of its endpoint: "walk.mp4"

    Raises
    ------
    ServiceError
        If `endpoint` is empty and not just one pipeline runs, or the keys cannot be read.
    """
    return Control(endpoint, timeout=timeout, keys=keys, source=source)
