"""Attach to a running pipeline: its messages one by one, as they come.

    import catstream

    with catstream.subscribe("run", "tracks") as tracks:
        for track in tracks:
            print(track.frame, track.state, track.box)

The pipeline never waits for who is attached: a slow one misses tracks, and `missed` counts them.
"""

from __future__ import annotations

import select
from time import monotonic
from typing import Generic, Literal, Self, TypeVar, overload

from catstream.errors import ServiceError, SilenceError
from catstream.messages import End, Features, Health, Model, Preview, Run, Sample, Track
from catstream.wire.announced import Announcement
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint, find
from catstream.wire.readable import readable
from catstream.wire.sockets import Subscriber

__all__ = ["GapCounter", "Subscription", "subscribe", "wait_until_running"]

#: Seconds that the last messages have to come in after the end was heard: it travels by itself.
_DRAIN_SECONDS = 0.5

#: Seconds to wait for a sign of life: each process of a running pipeline is heard once a second.
_HEALTH_TIMEOUT_SECONDS = 5.0

#: Seconds from one look at the connections to the next: they say if the pipeline does not let this reader in.
_CONNECTION_CHECK_SECONDS = 1.0

#: What one can subscribe to, and its channel: of features, that of the copies.
_SUBSCRIBABLE = {
    **{name: name for name, channel in CHANNELS.items() if not channel.acknowledged and name != "lessons"},
    "features": "lessons",
}

Message = TypeVar("Message", bound=Track | Model | Health | Sample | Features | Preview)


class GapCounter:
    """Counts messages of a stream that never came, by what is missing between their `seq`, which begins with 1.

    missed  since the first that came; a restarted sender may go back
    before  those before the first that came
    """

    def __init__(self) -> None:
        self.missed = self.before = self._seq = 0

    def take(self, seq: int) -> None:
        """Count what is missing before the next message that came, or before the end."""
        if self._seq:
            self.missed += max(0, seq - self._seq - 1)
        else:
            self.before = max(0, seq - 1)
        self._seq = seq


class Subscription(Generic[Message]):
    """Messages of one channel of a running pipeline, from now until its end; iterate it, with `for` or `async for`.

    Tracks and features come one a frame, a restarted detector may repeat some. Of models, samples, previews and the
    health of each process the last one comes at once, then each that is the newest when it is
    taken. At an endpoint that is named, it may be there before the pipeline: it waits, and gets every message from the
    first one on, as the pipeline begins once it is connected (on the same machine, of the same user).

    Attributes
    ----------
    end : End or None
        The pipeline's last message, None before it.
    endpoint : str
        Where it is attached.
    keys : str
        Folder of the keys that it connects with, empty without.
    timeout : float or None
        Seconds without a message after which iterating raises `SilenceError`.

    Raises
    ------
    SilenceError
        While iterating, if nothing came for as long as `timeout` says. It may be iterated on.
    ServiceError
        While iterating, if the pipeline does not let these keys in.
    """

    def __init__(self, endpoint: str, channel: str, *, timeout: float | None = None, keys: str = "") -> None:
        if channel not in _SUBSCRIBABLE:
            raise ServiceError(
                f"one can subscribe to {', '.join(_SUBSCRIBABLE)}, got {channel!r}: the others have one receiver"
            )
        place = find(endpoint, keys)
        self.endpoint, self.timeout = str(place), timeout
        self.keys = str(place.keys.folder) if place.keys is not None else ""
        self.end: End | None = None
        self._name, self._channel, self._gaps = channel, CHANNELS[_SUBSCRIBABLE[channel]], GapCounter()
        self._last_identity: dict[str, float] = {}  # of each process that sends: what was taken last
        self._close_time = float("inf")  # when to wait no more
        # A pipeline that begins here later waits until this subscription has come in.
        self._announcement = Announcement(place, [self._channel.name]) if self._channel.keeps == "every" else None
        self._messages = Subscriber(
            self._channel.name, place, reader=self._announcement.reader if self._announcement else ""
        )
        # By itself: a reader that is so slow that messages are dropped would miss the end among them.
        self._ends = Subscriber("tracks", place, only=End)

    @property
    def missed(self) -> int:
        """Tracks or features of the run that never came here: before it was attached, or because it was too slow."""
        return self._gaps.missed + self._gaps.before

    @property
    def missed_before(self) -> int:
        """How many of those were sent before it was attached."""
        return self._gaps.before

    def losses(self) -> str:
        """What is missing, for a person to read."""
        before = f", {self.missed_before} of them before this began to listen" if self.missed_before else ""
        return f"{self.missed} missed{before}"

    @property
    def refused(self) -> int:
        """Messages that were dropped because they were not what the channel carries."""
        return self._messages.refused

    def close(self) -> None:
        """Attach no more."""
        self._withdraw_announcement()
        self._messages.close()
        self._ends.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Message:
        deadline = self._deadline()
        while (message := self._take()) is None:
            if self._ended():
                raise StopIteration
            poller = select.poll()
            for socket in (self._messages, self._ends):
                poller.register(socket.fileno(), select.POLLIN)
            seconds = self._wait_seconds(deadline)
            poller.poll(seconds * 1000)
        return message

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        deadline = self._deadline()
        while (message := self._take()) is None:
            if self._ended():
                raise StopAsyncIteration
            await readable([self._messages, self._ends], self._wait_seconds(deadline))
        return message

    def _take(self) -> Message | None:
        """The next message, where it is here already."""
        while self._messages.pending():
            message = self._messages.receive(0)
            if isinstance(message, End):
                if self._channel.keeps == "every":  # nothing is on its way behind it
                    self.end, self._close_time = message, 0.0
                    return None
            elif message is not None and self._new(message):
                self._withdraw_announcement()
                return message
        while self._ends.pending():
            end = self._ends.receive(0)
            if self.end is None and end is not None:
                self.end, self._close_time = end, monotonic() + _DRAIN_SECONDS
        return None

    def _withdraw_announcement(self) -> None:
        """No pipeline has to wait for it any more."""
        if self._announcement is not None:
            self._announcement.close()

    def _new(self, message: Message) -> bool:
        """Whether it did not come before: a channel's last message is sent again when somebody new comes."""
        if isinstance(message, Run):
            return False
        if isinstance(message, Track | Features):
            self._gaps.take(message.seq)
            return True
        name, mark = _identity(message)
        known = self._last_identity.get(name)
        self._last_identity[name] = mark
        return mark != known

    def _ended(self) -> bool:
        if self.end is None or monotonic() < self._close_time:
            return False
        if self._channel.keeps == "every":
            self._gaps.take(self.end.seq)
        return True

    def _deadline(self) -> float:
        return float("inf") if self.timeout is None else monotonic() + self.timeout

    def _wait_seconds(self, deadline: float) -> float:
        """Seconds to wait before it is looked again; raises SilenceError if the time is over."""
        now = monotonic()
        if now >= deadline and self.end is None:
            raise SilenceError(
                f"no {self._name} came from {self.endpoint} within {self.timeout:g} s: is a pipeline running there?"
            )
        until = min(deadline if self.end is None else float("inf"), self._close_time, now + _CONNECTION_CHECK_SECONDS)
        return max(0.0, until - now)


def _identity(message: Health | Model | Sample | Preview) -> tuple[str, float]:
    """Who sent it, and what tells it from the one before."""
    if isinstance(message, Health):
        return message.process, message.time
    if isinstance(message, Preview):  # while no frame is followed, all of a live source have one number
        return "", hash((message.frame, message.jpeg))
    return "", message.version


@overload
def subscribe(
    endpoint: str, channel: Literal["tracks"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Track]: ...
@overload
def subscribe(
    endpoint: str, channel: Literal["models"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Model]: ...
@overload
def subscribe(
    endpoint: str, channel: Literal["health"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Health]: ...
@overload
def subscribe(
    endpoint: str, channel: Literal["samples"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Sample]: ...
@overload
def subscribe(
    endpoint: str, channel: Literal["features"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Features]: ...
@overload
def subscribe(
    endpoint: str, channel: Literal["previews"], *, timeout: float | None = ..., keys: str = ...
) -> Subscription[Preview]: ...
def subscribe(endpoint: str, channel: str, *, timeout: float | None = None, keys: str = "") -> Subscription:
    """Attach to a running pipeline.

    Parameters
    ----------
    endpoint : str
        Where it runs, or will run, as the setting `run.endpoint` says. Empty for the user's only running pipeline.
    channel : str
        "tracks", "models", "health", "samples", "features" or "previews".
    timeout : float or None
        Seconds without a message after which iterating raises `SilenceError`; None to wait for ever.
    keys : str
        Folder of the keys of this client, if the pipeline asks for some.

    Raises
    ------
    ServiceError
        If there is no such channel, `endpoint` is empty and not just one pipeline runs, or the keys cannot be read.
    """
    return Subscription(endpoint, channel, timeout=timeout, keys=keys)


def wait_until_running(endpoint: str, keys: str = "", seconds: float = _HEALTH_TIMEOUT_SECONDS) -> Endpoint:
    """Where a pipeline runs, once it is heard: tracks and models may be silent for long where one does.

    Raises
    ------
    ServiceError
        Where `endpoint` is empty and not just one pipeline runs.
    SilenceError
        If none is heard in time.
    """
    with subscribe(endpoint, "health", timeout=seconds, keys=keys) as health:
        next(health, None)
        return Endpoint.parse(health.endpoint, health.keys)
