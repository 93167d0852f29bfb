"""Subscribe to the messages of a running pipeline.

    import catstream

    with catstream.subscribe("run", "tracks") as tracks:
        for track in tracks:
            print(track.frame, track.state, track.box)

The pipeline never waits for a subscriber. A slow subscriber misses tracks, and `missed` counts them. With
`object="anna"`, only the messages about this object are transmitted.

`catstream.subscribe("fleet://cam-7", "tracks")` subscribes to a stream of a fleet, wherever it runs: the subscription
continues if the stream moves to another node.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack
from time import monotonic
from typing import Any, Generic, Literal, NamedTuple, Self, TypedDict, TypeVar, Unpack, cast, overload

from catstream.client.registry import FollowedStream, described, follow
from catstream.errors import ServiceError, SilenceError
from catstream.messages.kinds import End, Features, Health, Model, Preview, Run, Sample, Track
from catstream.messages.names import check_name
from catstream.wire.channels import CHANNELS, TRACKS
from catstream.wire.endpoint import Endpoint, Place, find
from catstream.wire.newest import GapCounter, Subscriber
from catstream.wire.readable import Turns, Wait, finish, finish_async
from catstream.wire.timing import CHECK_SECONDS, DRAIN_SECONDS, REPORT_SECONDS

#: Public name -> channel. Subscribers get features from the channel of copies; `catstream.control` gets saved models.
_SUBSCRIBABLE = {
    **{name: name for name in ("samples", "models", "tracks", "health", "previews")},
    "features": "training",
}

#: ZeroMQ connects again only while the subscriber reads: the end is lost if it did not read since a restart.
_GONE = "its sockets were removed, and this subscriber did not receive its end"

#: A message of any channel that can be subscribed to.
AnyMessage = Track | Model | Health | Sample | Features | Preview
Message = TypeVar("Message", bound=AnyMessage)


#: Public name of a channel whose messages are about one object each -> their kind.
_KINDS: dict[str, type] = {"tracks": Track, "models": Model, "samples": Sample}


class _Connection(NamedTuple):
    """The sockets of a subscription to one pipeline.

    endpoint  of the pipeline
    messages  receives the messages of the channel
    ends      receives the end: if this subscriber is slow, the end could be among the messages that are dropped
    """

    endpoint: Endpoint
    messages: Subscriber[Any]
    ends: Subscriber[Any]


class Subscription(Generic[Message]):
    """The messages of one channel of a running pipeline, until the pipeline ends; iterate with `for` or `async for`.

    There is one features message for each frame, and one track for each object and frame; after a restart of the
    detector some are repeated. For models, samples, previews and health reports, the last message arrives at once; then
    each iteration returns the newest, and older ones that were not read are dropped. Models and samples are kept for
    each object, and the object that has waited longest comes first. A subscriber to a named endpoint may start before
    the pipeline. If both run on the same machine as the same user, the pipeline waits for it, so that it receives every
    message.

    The subscription to a stream of a fleet continues if the stream moves or is started again, and while the registry of
    the fleet cannot be reached. It ends if the stream has ended, or was removed from the fleet. A frame that the stream
    repeats is not returned a second time; the frames that nobody tracked in between are counted in `missed`.

    Attributes
    ----------
    end : End or None
        The last message of the pipeline, or the reason why the stream of a fleet has ended; None before that. A
        pipeline whose sockets are gone from its folder has ended too.
    endpoint : str
        Endpoint of the pipeline, or the address of the stream.
    keys : str
        Folder of the client keys; empty if there are none.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`.

    Raises
    ------
    SilenceError
        During iteration, if no message arrived within `timeout`. Iteration may continue afterwards.
    ServiceError
        During iteration, if the pipeline rejects the keys, or the subscription is closed.
    """

    def __init__(
        self,
        endpoint: Place,
        channel: str,
        *,
        object: str | None = None,
        timeout: float | None = None,
        keys: str = "",
    ) -> None:
        if channel not in _SUBSCRIBABLE:
            raise ServiceError(
                f"expected one of the channels {', '.join(_SUBSCRIBABLE)}, got {channel!r}: subscribe to one of them"
            )
        if object is not None and channel not in _KINDS:
            raise ServiceError(
                f"a message of {channel} is about all objects: subscribe to {', '.join(_KINDS)} for one object, or to "
                f"{channel} without an object"
            )
        self._about = None if object is None else check_name(object)
        self.endpoint, self.keys, self.timeout = str(endpoint), keys, timeout
        self.end: End | None = None
        self._name, self._channel, self._gaps = channel, CHANNELS[_SUBSCRIBABLE[channel]], GapCounter()
        self._close_time = float("inf")  # until which messages may still arrive after the end
        self._rejected = 0  # by the connections before this one
        self._connection: _Connection | None = None
        self._has_run = False  # whether the pipeline was there before
        self._turns = Turns("subscription")
        self._stream = follow(endpoint, keys)
        if self._stream is not None:
            self._follow()
        else:
            place = find(endpoint, keys)
            self.endpoint, self.keys = str(place), str(place.keys.folder) if place.keys is not None else ""
            self._has_run = not place.lacks_sockets()
            self._connect(place, early=self._channel.keeps == "every")

    @property
    def missed(self) -> int:
        """Number of frames whose tracks or features were not received: sent before the connection, or dropped.

        For one object, the frames between its first and its last track that was received.
        """
        return self._gaps.missed + self._gaps.before

    @property
    def missed_before(self) -> int:
        """Number of those that were sent before the connection; 0 for one object, which may begin later."""
        return self._gaps.before

    def losses(self) -> str:
        """Describe the missed messages in words."""
        before = f", {self.missed_before} of them before this subscriber connected" if self.missed_before else ""
        return f"{self.missed} missed{before}"

    @property
    def place(self) -> Endpoint | None:
        """Endpoint of the connected pipeline; None if the stream of a fleet has not run yet."""
        return self._connection.endpoint if self._connection is not None else None

    @property
    def run(self) -> str:
        """Id of the run that the last message is from: of one start of one pipeline; empty if it is not known."""
        return self._connection.messages.run if self._connection is not None else ""

    @property
    def rejected(self) -> int:
        """Messages that were dropped because they were not what the channel carries."""
        return self._rejected + (self._connection.messages.rejected if self._connection is not None else 0)

    def close(self) -> None:
        """Disconnect. A loop of another thread or task ends with a ServiceError."""
        self._turns.close()
        self._disconnect()
        if self._stream is not None:
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Message:
        if (message := finish(self._turns.run(self._next()))) is None:
            raise StopIteration
        return message

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        if (message := await finish_async(self._turns.run(self._next()))) is None:
            raise StopAsyncIteration
        return message

    def _next(self) -> Generator[Wait, None, Message | None]:
        """Wait for the next message, and return it; None at the end."""
        deadline = float("inf") if self.timeout is None else monotonic() + self.timeout
        while (message := self._receive()) is None:
            self._follow()
            if self.end is not None and monotonic() >= self._close_time:
                # One object may have been forgotten before; the end of a fleet's stream may have no number.
                if self._channel.keeps == "every" and self._about is None and self.end.seq:
                    self._gaps.take(self.end.seq)
                return None
            if self.end is None and self._stream is None:
                self._look_for_sockets()
            yield Wait(self._sockets(), self._wait_seconds(deadline))
        self._has_run = True
        return message

    def _sockets(self) -> list[int]:
        """The sockets that are polled for messages."""
        sockets: list[Subscriber[Any] | FollowedStream] = [] if self._stream is None else [self._stream]
        if self._connection is not None:
            sockets += [self._connection.messages, self._connection.ends]
        return [socket.fileno() for socket in sockets]

    def _receive(self) -> Message | None:
        """Return the next message if one has arrived, without waiting."""
        if (connection := self._connection) is None:
            return None
        while (message := connection.messages.receive(0)) is not None:
            if self._stream is not None and not isinstance(message, End) and not self._stream.take(message):
                continue  # the stream was started again, and repeats a frame
            if isinstance(message, Track | Features):
                began = message.began if self._about is not None and isinstance(message, Track) else None
                self._gaps.take(message.seq, began)
            if not isinstance(message, Run | End):
                return cast(Message, message)
            if isinstance(message, End) and self._channel.keeps == "every":  # the last message here
                self._pipeline_ended(message, 0.0)
                return None
        for end in connection.ends.receive_all():
            if self.end is None and isinstance(end, End):
                self._pipeline_ended(end, monotonic() + DRAIN_SECONDS)
        return None

    def _pipeline_ended(self, end: End, close_time: float) -> None:
        """End at this time; a stream of a fleet may continue with another pipeline."""
        if self._stream is not None:
            self._stream.pipeline_ended(end)
        else:
            self.end, self._close_time = end, close_time

    def _follow(self) -> None:
        """Connect to the pipeline of a stream of a fleet if it has another one, and end if the stream has ended."""
        if self._stream is None or self.end is not None:
            return
        moved = self._stream.update()
        if self._stream.end is not None:
            self.end, self._close_time = self._stream.end, monotonic() + DRAIN_SECONDS
        elif (moved or self._connection is None) and (place := self._stream.place) is not None:
            self._disconnect()
            self._connect(place)

    def _look_for_sockets(self) -> None:
        """End if the pipeline has removed its sockets from its folder, which it does once it has ended."""
        lacks_sockets = self.place is not None and self.place.lacks_sockets()
        if lacks_sockets and self._has_run:
            self._pipeline_ended(End(0, _GONE), monotonic() + DRAIN_SECONDS)
        self._has_run = self._has_run or not lacks_sockets

    def _connect(self, place: Endpoint, *, early: bool = False) -> None:
        """Connect to a pipeline; if `early`, one that starts later waits for this subscription."""
        only = None if self._about is None else _KINDS[self._name]
        with ExitStack() as stack:
            messages = stack.enter_context(Subscriber(self._channel, place, only, about=self._about, early=early))
            self._connection = _Connection(place, messages, Subscriber(TRACKS, place, only=End))
            stack.pop_all()

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.messages.close()
            self._connection.ends.close()
            self._rejected += self._connection.messages.rejected
            self._connection = None

    def _wait_seconds(self, deadline: float) -> float:
        """Return the seconds to wait for the sockets. Raises SilenceError after the deadline."""
        now = monotonic()
        if now >= deadline and self.end is None:
            why = "is a pipeline running there?" if self._stream is None else described(self._stream.status)
            raise SilenceError(f"no {self._name} arrived from {self.endpoint} within {self.timeout:g} s: {why}")
        until = min(deadline if self.end is None else float("inf"), self._close_time, now + CHECK_SECONDS)
        return max(0.0, until - now)


class _Options(TypedDict, total=False):
    timeout: float | None
    keys: str


class _OfObject(_Options, total=False):
    object: str | None


@overload
def subscribe(endpoint: Place, channel: Literal["tracks"], **options: Unpack[_OfObject]) -> Subscription[Track]: ...
@overload
def subscribe(endpoint: Place, channel: Literal["models"], **options: Unpack[_OfObject]) -> Subscription[Model]: ...
@overload
def subscribe(endpoint: Place, channel: Literal["samples"], **options: Unpack[_OfObject]) -> Subscription[Sample]: ...
@overload
def subscribe(endpoint: Place, channel: Literal["health"], **options: Unpack[_Options]) -> Subscription[Health]: ...
@overload
def subscribe(endpoint: Place, channel: Literal["features"], **options: Unpack[_Options]) -> Subscription[Features]: ...
@overload
def subscribe(endpoint: Place, channel: Literal["previews"], **options: Unpack[_Options]) -> Subscription[Preview]: ...
def subscribe(
    endpoint: Place,
    channel: str,
    *,
    object: str | None = None,
    timeout: float | None = None,
    keys: str = "",
) -> Subscription[Any]:
    """Subscribe to a channel of a running pipeline.

    Parameters
    ----------
    endpoint : str or path
        Endpoint of the pipeline, which may start later; the format is that of the setting `run.endpoint`. Empty for the
        only running pipeline of this user. The address of a stream of a fleet is `fleet://HOST:PORT/STREAM`, with host
        and port of its registry; `fleet://FLEET/STREAM` for a fleet of this user, `fleet://STREAM` for the only one.
    channel : str
        "tracks", "models", "health", "samples", "features" or "previews".
    object : str or None
        Name of the one object whose tracks, models or samples are received; "" for the object without a name, None for
        all objects.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`; None to wait without limit.
    keys : str
        Folder of the keys of this client, if the pipeline requires keys.

    Raises
    ------
    ObjectError
        If `object` is not a valid name.
    ServiceError
        If there is no such channel, or its messages are not about one object each; if `endpoint` is empty and not
        exactly one pipeline runs; if the fleet has no such stream; or if the keys cannot be read.
    SilenceError
        If the registry of the fleet does not answer.
    """
    return Subscription(endpoint, channel, object=object, timeout=timeout, keys=keys)


def wait_until_running(endpoint: str, keys: str = "", seconds: float = REPORT_SECONDS) -> Endpoint:
    """Wait for a health report of the pipeline, and return its endpoint.

    Tracks and models are no sign of a running pipeline: they may pause for long.

    Raises
    ------
    ServiceError
        If `endpoint` is empty and not exactly one pipeline runs, the pipeline rejects the keys, or it has ended.
    SilenceError
        If no report arrives in time.
    """
    with Subscription[Health](endpoint, "health", timeout=seconds, keys=keys) as reports:
        if next(reports, None) is None or reports.place is None:
            reason = reports.end.reason if reports.end is not None else "it has no place"
            raise ServiceError(f"{endpoint or 'the pipeline'} does not run: {reason}")
        return reports.place
