"""Records the tracks, models and health reports of running pipelines with their arrival times."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass, field

from catstream.applications.loadtest.listening import arrivals
from catstream.messages.kinds import Health, Model, Track
from catstream.wire.channels import HEALTH, MODELS, TRACKS, Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber

__all__ = ["Observations", "Observer"]

_CHANNELS: tuple[Channel[object], ...] = (TRACKS, MODELS, HEALTH)


@dataclass(slots=True)
class Observations:
    """The messages of one pipeline with their arrival times by `time.monotonic`, oldest first.

    Of several objects, the one without a name is observed: its true boxes are known.

    tracks  tracks in order of arrival; a restarted detector may repeat a `seq` with another frame
    models  newest training frame of each model, numbered as the tracks were at its arrival
    health  health reports of all processes
    first_motion_version  version of the first model with a motion model, 0 before it
    """

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
            case Track(object=""):
                self.tracks.append((moment, message))
            case Model(object=""):
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

    def __init__(self, endpoints: list[str], keys: str) -> None:
        super().__init__(name="observer", daemon=True)
        self.observations = [Observations() for _ in endpoints]
        self._endpoints = [Endpoint.parse(endpoint, keys) for endpoint in endpoints]
        self._ended = threading.Event()

    def run(self) -> None:
        with ExitStack() as stack:
            readers = {
                (number, channel.name): stack.enter_context(Subscriber(channel, place))
                for number, place in enumerate(self._endpoints)
                for channel in _CHANNELS
            }
            for (number, _), moment, message in arrivals(readers, self._ended.is_set):
                self.observations[number].add(moment, message)

    def end(self) -> None:
        self._ended.set()
        self.join()
