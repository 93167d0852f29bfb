"""Subscriptions to streams of fleets, which follow a stream from node to node."""

from __future__ import annotations

from time import monotonic
from typing import Any, TypeVar

from catstream.base.names import UNNAMED
from catstream.client.registry import Registry, described
from catstream.client.subscription import DRAIN_SECONDS, Subscription
from catstream.wire.messages import End, Features, StreamStatus, Track

_QUERY_SECONDS = 1.0  # interval of queries to the registry while no message arrives

Message = TypeVar("Message")


class StreamSubscription(Subscription[Message]):
    """A subscription to a stream of a fleet: it reconnects when the stream moves, and drops repeated frames.

    While no message arrives, the registry is queried once a second; if it does not answer, the last answer remains
    valid. The end of a pipeline is the end of the stream only if the registry reports it: a stream that moves stops on
    one node, and continues on another.
    """

    def __init__(self, registry: Registry, stream: str, channel: str, **options: Any) -> None:
        self._registry, self._stream = registry, stream
        self._status = StreamStatus(stream, "starting")  # the newest one
        self._connected = self._status  # the status at the last connection to a pipeline
        self._frames: dict[str, int] = {}  # the newest frame of each object
        self._pipeline_end: End | None = None
        self._next_query = monotonic() + _QUERY_SECONDS
        try:
            super().__init__(None, channel, **options)
            self._update(registry.stream(stream))
        except BaseException:
            registry.close()
            raise

    def close(self) -> None:
        super().close()
        with self._lock:
            self._registry.close()

    def _receive(self) -> Message | None:
        while (message := super()._receive()) is not None:
            self._next_query = monotonic() + _QUERY_SECONDS
            if not isinstance(message, Track | Features):
                return message
            name = message.object if isinstance(message, Track) else UNNAMED
            if message.frame > self._frames.get(name, -1):  # otherwise, the stream has restarted and repeats it
                self._frames[name] = message.frame
                return message
        return None

    def _pipeline_ended(self, end: End, seconds: float) -> None:  # noqa: ARG002  # it may continue elsewhere
        self._pipeline_end, self._next_query = self._pipeline_end or end, monotonic()
        if self.end is not None and self._status.state == "ended":  # the answer of the registry was received first
            self.end = self._pipeline_end

    def _look_for_pipeline(self) -> None:
        """Query the registry once an interval, and process its answer if it has arrived."""
        if monotonic() >= self._next_query:
            self._registry.request(self._stream)
            self._next_query = monotonic() + _QUERY_SECONDS
        if (answer := self._registry.receive()) is None:
            return
        if self._stream in answer.streams:
            self._update(answer.streams[self._stream])
        else:
            gone = f"the stream {self._stream} was removed from the fleet {answer.name}, or the fleet is down"
            super()._pipeline_ended(End(0, gone), DRAIN_SECONDS)

    def _update(self, status: StreamStatus) -> None:
        """Apply a status of the registry: connect to another pipeline of the stream, or end with the stream."""
        before, self._status = self._connected, status
        if status.endpoint and (
            (status.endpoint, status.server, status.token) != (before.endpoint, before.server, before.token)
        ):
            # A live stream reuses the numbers of lost frames, and another source counts from 0.
            if status.live or status.source != before.source:
                self._frames.clear()
            self._connected, self._pipeline_end = status, None
            self._connect(self._registry.endpoint_of(status))
        if status.state == "ended":
            end = self._pipeline_end or End(0, f"the stream {self._stream} has ended")
            super()._pipeline_ended(end, DRAIN_SECONDS)

    def _silence(self) -> str:
        return f"the state of the stream is: {described(self._status)}"
