"""Records the tracks, models and health reports of running pipelines with their arrival times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic

from catstream.client.subscription import Subscription
from catstream.errors import SilenceError
from catstream.messages.kinds import Health, Model, Track

_POLL_SECONDS = 0.1


@dataclass(slots=True)
class Observations:
    """The messages of one pipeline with their arrival times by `time.monotonic`, oldest first.

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

    def add(self, moment: float, message: Track | Model | Health) -> None:
        """Add a message that arrived at a moment."""
        if isinstance(message, Track):
            self.tracks.append((moment, message))
        elif isinstance(message, Model):
            self.models.append((moment, message.frame))
            if message.motion is not None:
                self.first_motion_version = self.first_motion_version or message.version
        else:
            self.health.append((moment, message))


@contextmanager
def observed(endpoints: Sequence[str], name: str, keys: str) -> Iterator[list[Observations]]:
    """Observe one object of each pipeline in threads, which end with the context or with their pipelines."""
    seen, ended = [Observations() for _ in endpoints], Event()

    def observe(endpoint: str, channel: str, observations: Observations) -> None:
        about = None if channel == "health" else name
        messages: Subscription[Track | Model | Health] = Subscription(
            endpoint, channel, object=about, timeout=_POLL_SECONDS, keys=keys
        )
        with messages:
            while not ended.is_set():
                try:
                    message = next(messages)
                except SilenceError:
                    continue
                except StopIteration:
                    return
                observations.add(monotonic(), message)

    threads = [
        Thread(target=observe, args=(endpoint, channel, each), name=f"observer of {channel}", daemon=True)
        for endpoint, each in zip(endpoints, seen, strict=True)
        for channel in ("tracks", "models", "health")
    ]
    for thread in threads:
        thread.start()
    try:
        yield seen
    finally:
        ended.set()
        for thread in threads:
            thread.join()
