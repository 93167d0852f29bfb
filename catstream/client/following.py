"""Subscribe to a stream of a fleet, wherever it runs."""

from __future__ import annotations

from time import monotonic
from typing import Any, TypeVar

from catstream.base.names import UNNAMED
from catstream.client.registry import Registry, described
from catstream.client.subscription import DRAIN_SECONDS, Subscription
from catstream.wire.messages import End, Features, StreamStatus, Track

_QUIET_SECONDS = 1.0  # without a message of a stream, after which the registry is asked where it runs; then repeated

Message = TypeVar("Message")


class StreamSubscription(Subscription[Message]):
    """The messages of a stream of a fleet: the subscription reconnects wherever the stream runs, and drops repeats.

    While nothing arrives, the registry is asked once a second where the stream runs. If it does not answer, the last
    answer holds. The end of a pipeline is the end of the stream only if the registry says so: a stream that moves is
    stopped on one node, and continues on another. A frame that the stream repeats is not returned a second time.
    """

    def __init__(self, registry: Registry, stream: str, channel: str, **options: Any) -> None:
        self._registry, self._stream = registry, stream
        self._status = self._at_start = StreamStatus(stream, "starting")  # newest state; that when its pipeline started
        self._frames: dict[str, int] = {}  # the newest frame of each object
        self._pipeline_end: End | None = None
        self._next_question = monotonic() + _QUIET_SECONDS
        try:
            super().__init__(None, channel, **options)
            self._update(registry.stream(stream))
        except BaseException:
            registry.close()
            raise

    def close(self) -> None:
        super().close()
        with self._turn:
            self._registry.close()

    def _receive(self) -> Message | None:
        while (message := super()._receive()) is not None:
            self._next_question = monotonic() + _QUIET_SECONDS
            if not isinstance(message, Track | Features):
                return message
            name = message.object if isinstance(message, Track) else UNNAMED
            if message.frame > self._frames.get(name, -1):  # else the stream was started again, and repeats it
                self._frames[name] = message.frame
                return message
        return None

    def _pipeline_ended(self, end: End, seconds: float) -> None:  # noqa: ARG002  # it may continue elsewhere
        self._pipeline_end, self._next_question = self._pipeline_end or end, monotonic()
        if self.end is not None and self._status.state == "ended":  # the answer of the registry was received first
            self.end = self._pipeline_end

    def _look_for_pipeline(self) -> None:
        """Ask the registry if it is time to, and take its answer if it has arrived."""
        if monotonic() >= self._next_question:
            self._registry.request(self._stream)
            self._next_question = monotonic() + _QUIET_SECONDS
        if (answer := self._registry.receive()) is None:
            return
        if self._stream in answer.streams:
            self._update(answer.streams[self._stream])
        else:
            gone = f"the stream {self._stream} was removed from the fleet {answer.name}, or the fleet is down"
            super()._pipeline_ended(End(0, gone), DRAIN_SECONDS)

    def _update(self, status: StreamStatus) -> None:
        """Take the state from the registry: connect to another pipeline of the stream, or end with the stream."""
        before, self._status = self._at_start, status
        if status.endpoint and (
            (status.endpoint, status.server, status.token) != (before.endpoint, before.server, before.token)
        ):
            # A live stream uses the numbers of lost frames again, and another source counts from 0.
            if status.live or status.source != before.source:
                self._frames.clear()
            self._at_start, self._pipeline_end = status, None
            self._connect(self._registry.endpoint_of(status))
        if status.state == "ended":
            end = self._pipeline_end or End(0, f"the stream {self._stream} has ended")
            super()._pipeline_ended(end, DRAIN_SECONDS)

    def _silence(self) -> str:
        return f"the state of the stream is: {described(self._status)}"
