"""Records the tracks, models and health reports of running pipelines with their arrival times."""

from __future__ import annotations

import select
import threading
from contextlib import ExitStack
from dataclasses import dataclass, field
from time import monotonic

from catstream.messages.kinds import End, Health, Model, Track
from catstream.messages.names import UNNAMED
from catstream.wire.channels import HEALTH, MODELS, TRACKS, Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber

__all__ = ["Observations", "Observer"]

_CHANNELS: tuple[Channel[object], ...] = (TRACKS, MODELS, HEALTH)
_POLL_SECONDS = 0.1


@dataclass(slots=True)
class Observations:
    """The messages of one pipeline with their arrival times by `time.monotonic`, oldest first.

    name    name of the observed object
    tracks  tracks in order of arrival; a restarted detector may repeat a `seq` with another frame
    models  newest training frame of each model, numbered as the tracks were at its arrival
    health  health reports of all processes
    first_motion_version  version of the first model with a motion model, 0 before it
    """

    name: str = UNNAMED
    tracks: list[tuple[float, Track]] = field(default_factory=list)
    models: list[tuple[float, int]] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)
    first_motion_version: int = 0

    @property
    def warmed_up(self) -> bool:
        """Whether the start-up phase is over: the detector uses a model with a motion model."""
        return (
            self.first_motion_version > 0
            and bool(self.tracks)
            and self.tracks[-1][1].model_version >= self.first_motion_version
        )

    def add(self, moment: float, message: object) -> None:
        """Add a message that arrived at a moment."""
        match message:
            case Track(object=self.name):
                self.tracks.append((moment, message))
            case Model(object=self.name):
                self.models.append((moment, message.frame))
                if message.motion is not None:
                    self.first_motion_version = self.first_motion_version or message.version
            case Health():
                self.health.append((moment, message))


class Observer(threading.Thread):
    """A thread that subscribes to the pipelines until `end` is called.

    Attributes
    ----------
    observations : observations of each endpoint
    """

    def __init__(self, endpoints: list[str], keys: str, name: str = UNNAMED) -> None:
        super().__init__(name="observer", daemon=True)
        self.observations = [Observations(name) for _ in endpoints]
        self._endpoints = [Endpoint.parse(endpoint, keys) for endpoint in endpoints]
        self._ended = threading.Event()

    def run(self) -> None:
        poller, open_readers = select.poll(), dict[int, tuple[Observations, Subscriber[object]]]()
        with ExitStack() as stack:
            for observations, place in zip(self.observations, self._endpoints, strict=True):
                for channel in _CHANNELS:
                    reader = stack.enter_context(Subscriber(channel, place))
                    open_readers[reader.fileno()] = observations, reader
                    poller.register(reader.fileno(), select.POLLIN)
            while open_readers and not self._ended.is_set():
                for handle, _ in poller.poll(1000 * _POLL_SECONDS):
                    observations, reader = open_readers[handle]
                    while (message := reader.receive(0)) is not None:
                        observations.add(monotonic(), message)
                        if isinstance(message, End):
                            poller.unregister(handle)
                            del open_readers[handle]
                            break

    def end(self) -> None:
        self._ended.set()
        self.join()
