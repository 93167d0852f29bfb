"""What can be observations of running pipelines from outside, and when: their tracks, models and health."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass, field

from catstream.loadtest.listening import arrivals
from catstream.messages import Health, Model, Track
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Subscriber

__all__ = ["Observations", "Observer"]


@dataclass(slots=True)
class Observations:
    """What came from one pipeline, each with its moment by `time.monotonic`, oldest first.

    tracks  as they came; a restarted detector may repeat a `seq`, with another frame
    models  the frame of each, in the numbers that tracks had when it came
    health  counters of each process
    first_motion_version  version of the first model that knows how the object moves, 0 before it
    """

    tracks: list[tuple[float, Track]] = field(default_factory=list)
    models: list[tuple[float, int]] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)
    first_motion_version: int = 0

    @property
    def warmed_up(self) -> bool:
        """Whether all that happens only once has happened: the detector has gone on with such a model."""
        return (
            self.first_motion_version > 0
            and bool(self.tracks)
            and self.tracks[-1][1].model_version >= self.first_motion_version
        )


class Observer(threading.Thread):
    """Subscribes like anybody else, and writes down the moment; `end` it.

    Attributes
    ----------
    observations : of each endpoint
    """

    def __init__(self, endpoints: list[str], keys: str) -> None:
        super().__init__(name="observer", daemon=True)
        self.observations = [Observations() for _ in endpoints]
        self._endpoints = [Endpoint.parse(endpoint, keys) for endpoint in endpoints]
        self._ended = threading.Event()

    def run(self) -> None:
        with ExitStack() as stack:
            readers = {
                (number, channel): stack.enter_context(Subscriber(channel, place))
                for number, place in enumerate(self._endpoints)
                for channel in ("tracks", "models", "health")
            }
            for (number, _), moment, message in arrivals(readers, self._ended.is_set):
                match message:
                    case Track():
                        self.observations[number].tracks.append((moment, message))
                    case Model():
                        observations = self.observations[number]
                        observations.models.append((moment, message.frame))
                        if message.motion is not None:
                            observations.first_motion_version = observations.first_motion_version or message.version
                    case Health():
                        self.observations[number].health.append((moment, message))

    def end(self) -> None:
        self._ended.set()
        self.join()
