"""Follow a stream of a fleet: its messages and its commands, wherever it runs."""

from __future__ import annotations

import contextlib
from time import monotonic
from typing import Any, TypeVar

from catstream.base.names import UNNAMED
from catstream.client.control import ANSWER_SECONDS, Control
from catstream.client.registry import Registry, described
from catstream.client.subscription import DRAIN_SECONDS, Subscription
from catstream.errors import ServiceError, SilenceError
from catstream.messages.kinds import Answer, End, Features, StreamStatus, Track, Verb
from catstream.wire.endpoint import Endpoint

_QUIET_SECONDS = 1.0  # without a message of a stream, after which the registry is asked where it runs; then repeated
_ANSWER_SECONDS = 1.0  # for the registry before each command; without an answer, the stream has not moved

Message = TypeVar("Message")


class FollowedStream:
    """Follows a stream of a fleet from one pipeline to the next, without waiting.

    While nothing arrives from the stream's pipeline, the registry is asked once a second where the stream runs. If the
    registry does not answer, the last answer holds. The end of a pipeline is the end of the stream only if the registry
    says so: a stream that moves is stopped on one node, and continues on another one.

    registry  of the fleet; it is closed with this object
    endpoint  of its pipeline; of the last one while it does not run; None before the first
    status    its newest state
    end       the reason why the stream has ended; None while it continues
    """

    def __init__(self, registry: Registry, stream: str) -> None:
        self._stream, self._registry = stream, registry
        self._pipeline_end: End | None = None
        self._frames: dict[str, int] = {}  # the newest frame of each object
        self.end: End | None = None
        self.endpoint: Endpoint | None = None
        self.status = self._at_start = StreamStatus(stream, "starting")  # newest state; that when its pipeline started
        try:
            self._update(registry.stream(stream))
        except ServiceError:
            registry.close()
            raise
        self._next_question = monotonic() + _QUIET_SECONDS

    def take(self, message: object) -> bool:
        """Note a message from the pipeline; returns False if it is of a frame that the stream has repeated.

        The registry is not asked while there are any.
        """
        self._next_question = monotonic() + _QUIET_SECONDS
        if isinstance(message, Track | Features):
            name = message.object if isinstance(message, Track) else UNNAMED
            if message.frame <= self._frames.get(name, -1):
                return False
            self._frames[name] = message.frame
        return True

    def pipeline_ended(self, end: End) -> None:
        """Report the end of the pipeline: the registry is asked at once whether it is that of the stream."""
        self._pipeline_end, self._next_question = self._pipeline_end or end, monotonic()

    def update(self) -> bool:
        """Ask if it is time to, and take the answer if it has arrived; returns whether it has another pipeline."""
        now = monotonic()
        if now >= self._next_question:
            self._registry.request(self._stream)
            self._next_question = now + _QUIET_SECONDS
        if (answer := self._registry.receive()) is None:
            return False
        if self._stream not in answer.streams:
            gone = f"the stream {self._stream} was removed from the fleet {answer.name}, or the fleet is down"
            self.end = End(0, gone)
            return False
        return self._update(answer.streams[self._stream])

    def ask(self, seconds: float) -> None:
        """Ask the registry now, and wait for the answer; the last one holds if none arrives in time."""
        self._registry.timeout = seconds
        with contextlib.suppress(SilenceError):
            self._update(self._registry.stream(self._stream))

    @property
    def running(self) -> Endpoint:
        """The endpoint of its pipeline by the last answer; ServiceError if it does not run."""
        if self.endpoint is None or not self.status.endpoint:
            raise ServiceError(f"stream {self._stream} is not running (state: {described(self.status)})")
        return self.endpoint

    def close(self) -> None:
        self._registry.close()

    def _update(self, status: StreamStatus) -> bool:
        """Take the state from the registry, which may be the end; returns whether the stream has another pipeline."""
        before, self.status = self._at_start, status
        moved = bool(status.endpoint) and (
            (status.endpoint, status.server, status.token) != (before.endpoint, before.server, before.token)
        )
        if moved:
            # A live stream uses the numbers of lost frames again, and another source counts from 0.
            if status.live or status.source != before.source:
                self._frames.clear()
            self.endpoint, self._at_start, self._pipeline_end = self._registry.endpoint_of(status), status, None
        if status.state == "ended":
            self.end = self._pipeline_end or End(0, f"the stream {self._stream} has ended")
        return moved


class StreamSubscription(Subscription[Message]):
    """The messages of a stream of a fleet: the subscription reconnects wherever the stream runs, and drops repeats.

    It continues while the registry cannot be reached, and ends with the stream. A frame that the stream repeats is not
    returned a second time.
    """

    def __init__(self, registry: Registry, stream: str, channel: str, **options: Any) -> None:
        self._stream = FollowedStream(registry, stream)
        try:
            super().__init__(self._stream.endpoint, channel, **options)
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        super().close()
        with self._turn:
            self._stream.close()

    def _receive(self) -> Message | None:
        while (message := super()._receive()) is not None and not self._stream.take(message):
            pass  # the stream was started again, and repeats a frame
        return message

    def _pipeline_ended(self, end: End, seconds: float) -> None:  # noqa: ARG002  # it may continue elsewhere
        self._stream.pipeline_ended(end)

    def _look_for_pipeline(self) -> None:
        """Connect to another pipeline of the stream, or end with the stream."""
        moved = self._stream.update()
        if self._stream.end is not None:
            super()._pipeline_ended(self._stream.end, DRAIN_SECONDS)
        elif self._stream.endpoint is not None and (moved or self.endpoint is None):
            self._connect(self._stream.endpoint)

    def _silence(self) -> str:
        return f"the state of the stream is: {described(self._stream.status)}"


class StreamControl(Control):
    """Sends each command to the pipeline that a stream of a fleet has at that moment."""

    def __init__(self, registry: Registry, stream: str, *, timeout: float = ANSWER_SECONDS) -> None:
        self._stream = FollowedStream(registry, stream)
        try:
            super().__init__(self._stream.running, timeout=timeout)
        except BaseException:
            self._stream.close()
            raise

    def execute(self, verb: Verb, object: str = UNNAMED, **fields: Any) -> Answer:
        self._stream.ask(_ANSWER_SECONDS)
        if (endpoint := self._stream.running) != self.endpoint:
            super().close()
            self._connect(endpoint)
        return super().execute(verb, object, **fields)

    def close(self) -> None:
        super().close()
        self._stream.close()
