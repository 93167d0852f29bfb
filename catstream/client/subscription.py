"""Subscribe to the messages of a running pipeline.

    import catstream

    with catstream.subscribe("run", "tracks") as tracks:
        for track in tracks:
            print(track.frame, track.state, track.box)

The pipeline never waits for a subscriber. A slow subscriber misses tracks, and `missed` counts them; `behind` is the
age of the last one, and with `newest=True` older ones are passed over. With `object="anna"`, only the messages about
this object are transmitted.

`catstream.subscribe("fleet://cam-7", "tracks")` subscribes to a stream of a fleet, wherever it runs: the subscription
continues if the stream moves to another node.
"""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from time import monotonic
from typing import Any, Generic, Self, TypeVar, cast

import zmq
import zmq.asyncio

from catstream.base.clock import RunningClock
from catstream.base.names import check_name
from catstream.client.registry import FollowedStream, described, follow
from catstream.errors import ServiceError, SilenceError
from catstream.messages.kinds import End, Features, Health, Track, run_state
from catstream.wire.channels import HEALTH, PUBLIC, TRACKS
from catstream.wire.endpoint import Endpoint, Place, find
from catstream.wire.newest import GapCounter, Subscriber
from catstream.wire.socket import check_owner

REPORT_SECONDS = 5.0  #: for a health report, by default; each process of a running pipeline sends one every second
CHECK_SECONDS = 0.2  #: between two checks whether the pipeline has rejected the keys or removed its sockets, or moved
REASON_SECONDS = 2.0  #: before the end of a time-out, in which a health report says why nothing arrives
DRAIN_SECONDS = 0.5  #: for messages after the end, which arrives on a connection of its own and may overtake them
#: Why nothing arrives from a folder without sockets.
REMOVED = "is a pipeline running there? It has no sockets: if it runs, they were removed; end it and start it again"

Message = TypeVar("Message")


class Subscription(Generic[Message]):
    """The messages of one channel of a running pipeline, until the pipeline ends; iterate with `for` or `async for`.

    There is one features message for each frame, and one track for each object and frame; after a restart of the
    detector some are repeated. Of models, samples, previews and health reports, the last ones arrive at once; then each
    iteration returns the newest, and older ones that were not read are dropped. Models and samples are kept for each
    object, and the object that has waited longest comes first. With `newest`, the same holds for tracks and features.

    The subscription to a stream of a fleet continues if the stream moves or is started again, and while the registry of
    the fleet cannot be reached. A frame that the stream repeats is not returned a second time.

    Attributes
    ----------
    end : End or None
        The last message of the pipeline, or the reason why the stream of a fleet has ended or why there is no such
        message; None before that.
    endpoint, keys : str
        Endpoint of the pipeline, or the address of the stream; folder of the client keys, empty if there are none.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`; it may continue afterwards. With a
        time-out of two seconds or more, the error says whether the run is paused, waits for a box or has lost its
        source.
    place : Endpoint or None
        Endpoint of the connected pipeline; None if the stream of a fleet has not run yet.

    Raises
    ------
    SilenceError
        During iteration, if no message arrived within `timeout`.
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
        newest: bool = False,
    ) -> None:
        if channel not in PUBLIC:
            raise ServiceError(
                f"expected one of the channels {', '.join(PUBLIC)}, got {channel!r}: subscribe to one of them"
            )
        self._name, self._channel, self._gaps = channel, PUBLIC[channel], GapCounter()
        if object is not None and not self._channel.by_object:
            names = ", ".join(name for name, row in PUBLIC.items() if row.by_object)
            raise ServiceError(
                f"a message of {channel} is about all objects: subscribe to {names} for one object, or to {channel} "
                "without an object"
            )
        self._about = None if object is None else check_name(object)
        self.endpoint, self.keys, self.timeout, self._newest_only = str(endpoint), keys, timeout, newest
        self.end: End | None = None
        self.place: Endpoint | None = None
        self._close_time = float("inf")  # until which messages may still arrive after the end
        # The end has a socket of its own: if this subscriber is slow, it could be among the messages that are dropped.
        self._messages: Subscriber[Any] | None = None
        self._ends: Subscriber[Any] | None = None
        self._health: Subscriber[Health] | None = None  # once `behind` was asked for, or nothing has arrived for long
        self._read = self._newest = 0.0  # times of the frame that was read last, and of the newest one that is known
        self._clock = RunningClock()  # of the time limit
        self._state = ""  # of the pipeline, as a health report has said while a message is awaited
        self._has_run = False  # whether the pipeline was there before
        self._over = self._closed = False
        self._owner = os.getpid()
        self._turn = threading.RLock()  # a thread or a signal handler may close while another thread waits
        self._stream = follow(endpoint, keys)
        if self._stream is not None:
            self._follow(self._stream)
        else:
            place = find(endpoint, keys)
            self.endpoint, self.keys = str(place), str(place.keys.folder) if place.keys is not None else ""
            self._has_run = not place.lacks_sockets()
            self._connect(place)

    @property
    def missed(self) -> int:
        """Number of frames whose tracks or features were not received, or were passed over.

        Those of one object count between its first and its last frame.
        """
        return self._gaps.missed + self._gaps.before

    @property
    def missed_before(self) -> int:
        """Number of those that were sent before the connection; 0 for one object, which may begin later."""
        return self._gaps.before

    def losses(self) -> str:
        """Describe the missed messages in words."""
        before = f", {self._gaps.before} of them before this subscriber connected" if self._gaps.before else ""
        return f"{self.missed} missed{before}"

    @property
    def behind(self) -> float:
        """Age of the track or features that were read last: seconds of the source from their frame to the newest one.

        It is known from the health reports of the pipeline, one a second, which are received from the first call on; 0
        before the first report, and on other channels.
        """
        with self._turn:
            if self._channel.keeps == "every":
                self._receive_health()
            return max(0.0, self._newest - self._read)

    @property
    def run(self) -> str:
        """Id of the run that the last message is from: of one start of one pipeline; empty if it is not known."""
        return self._messages.run if self._messages is not None else ""

    def close(self) -> None:
        """Disconnect. A loop of another thread or task ends with a ServiceError, soon."""
        self._closed = True
        with self._turn:
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
        deadline = self._deadline()
        while (message := self._take(deadline)) is None:
            if self._over:
                raise StopIteration
            self._poller(zmq.Poller()).poll(self._milliseconds(deadline))
        return message

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        deadline = self._deadline()
        while (message := self._take(deadline)) is None:
            if self._over:
                raise StopAsyncIteration
            await self._poller(zmq.asyncio.Poller()).poll(self._milliseconds(deadline))
        return message

    def _deadline(self) -> float:
        """The end of the time-out of a message that is awaited from now on."""
        self._state = ""
        return float("inf") if self.timeout is None else self._clock() + self.timeout

    def _poller(self, poller: Any) -> Any:
        """A poller of the sockets, by their descriptors, which another thread may close meanwhile."""
        for socket in (self._messages, self._ends):
            if socket is not None and not self._closed:
                poller.register(socket.fileno(), zmq.POLLIN)
        return poller

    def _milliseconds(self, deadline: float) -> float:
        """The time to wait for the sockets."""
        left = self._close_time - monotonic() if self.end is not None else deadline - self._clock()
        return 1000 * max(0.0, min(left, CHECK_SECONDS))

    def _take(self, deadline: float) -> Message | None:
        """The next message if one has arrived, without waiting; what else is to be done before the next wait."""
        check_owner(self._owner)  # first: another thread of the original may have held the lock
        with self._turn:
            if self._closed:
                raise ServiceError("the subscription was closed, perhaps by another thread or task: make another one")
            if (message := self._receive()) is not None:
                self._has_run = True
                return message
            if self.end is None:
                self._look_for_pipeline()
            if self.end is None and (self.timeout or 0.0) >= REASON_SECONDS > deadline - self._clock():
                self._receive_health()
            if self.end is None and self._clock() >= deadline:
                raise SilenceError(
                    f"no {self._name} arrived from {self.endpoint} within {self.timeout:g} s: {self._why_silent()}"
                )
            self._over = self.end is not None and monotonic() >= self._close_time
            # One object may have been forgotten before; the end of a fleet's stream may have no number.
            if self._over and self.end and self.end.seq and self._channel.keeps == "every" and self._about is None:
                self._gaps.take(self.end.seq)
            return None

    def _receive(self) -> Message | None:
        if self._ends is not None:
            self._ends.pending()  # ZeroMQ subscribes again at a restarted pipeline only while the socket is looked at
        while self._messages is not None and (message := self._messages.receive(0)) is not None:
            if isinstance(message, End):
                if self._channel.keeps == "every":  # the last message here
                    self._pipeline_ended(message, 0.0)
                continue
            if self._stream is not None and not self._stream.take(message):
                continue  # the stream was started again, and repeats a frame
            if isinstance(message, Track | Features):
                began = message.began if self._about is not None and isinstance(message, Track) else None
                self._gaps.take(message.seq, began)
                self._read = message.time
            return cast(Message, message)
        if self._ends is not None and self.end is None and (end := self._ends.receive(0)) is not None:
            self._pipeline_ended(end, DRAIN_SECONDS)
        return None

    def _receive_health(self) -> None:
        """Take the health reports of the detector that have arrived; the last one arrives at once."""
        if self._health is None and self.place is not None and self._channel is not HEALTH:
            self._health = Subscriber(HEALTH, self.place)
        for report in self._health.receive_all() if self._health is not None else ():
            if report.process == "detector":
                self._newest, self._state = report.counters.get("time", self._newest), run_state(report.counters)[1]

    def _why_silent(self) -> str:
        """The reason why no message arrives, as far as it is known."""
        if self._stream is not None:
            return described(self._stream.status)
        if self._state:
            return f"the state of the pipeline is: {self._state}"
        removed = self.place is not None and self.place.lacks_sockets()
        return REMOVED if removed else "is a pipeline running there?"

    def _pipeline_ended(self, end: End, seconds: float) -> None:
        """End after so many seconds; a stream of a fleet may continue with another pipeline."""
        if self._stream is not None:
            self._stream.pipeline_ended(end)
        else:
            self.end, self._close_time = end, monotonic() + seconds

    def _look_for_pipeline(self) -> None:
        """Follow a stream of a fleet; end if the pipeline has removed its sockets from its folder, as it does at last.

        A subscriber that did not read since a restart has no subscription there, and misses the end.
        """
        if self._stream is not None:
            self._follow(self._stream)
        elif self.place is not None and not self.place.lacks_sockets():
            self._has_run = True
        elif self._has_run:
            gone = "its sockets were removed, and this subscriber did not receive its end"
            self._pipeline_ended(End(0, gone), DRAIN_SECONDS)

    def _follow(self, stream: FollowedStream) -> None:
        """Connect to the pipeline of a stream of a fleet if it has another one, and end if the stream has ended."""
        moved = stream.update()
        if stream.end is not None:
            self.end, self._close_time = stream.end, monotonic() + DRAIN_SECONDS
        elif (moved or self._messages is None) and (place := stream.place) is not None:
            self._disconnect()
            self._connect(place)

    def _connect(self, place: Endpoint) -> None:
        only = None if self._about is None else self._channel.messages[0]
        with ExitStack() as stack:
            messages = Subscriber[Any](self._channel, place, only, about=self._about, newest=self._newest_only)
            self._messages = stack.enter_context(messages)
            self._ends, self.place = Subscriber(TRACKS, place, only=End), place
            stack.pop_all()

    def _disconnect(self) -> None:
        if self._messages is not None and self._ends is not None:
            self._messages.close()
            self._ends.close()
        if self._health is not None:
            self._health.close()
        self._messages = self._ends = self._health = None


def subscribe(
    endpoint: Place,
    channel: str,
    *,
    object: str | None = None,
    timeout: float | None = None,
    keys: str = "",
    newest: bool = False,
) -> Subscription[Any]:
    """Subscribe to a channel of a running pipeline.

    Parameters
    ----------
    endpoint : str or path
        Endpoint of the pipeline, which may start later, as in the setting `run.endpoint`; empty for the only running
        pipeline of this user. Or the address of a stream of a fleet: `fleet://HOST:PORT/STREAM` with host and port of
        its registry, `fleet://FLEET/STREAM` for a fleet of this user, `fleet://STREAM` for the only one.
    channel : str
        "tracks", "models", "health", "samples", "features" or "previews": the messages are `Track`, `Model` and so on
        of `catstream.messages.kinds`.
    object : str or None
        Name of the one object whose tracks, models or samples are received; "" for the object without a name, None for
        all objects.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`; None to wait without limit.
    keys : str
        Folder of the keys of this client, if the pipeline requires keys.
    newest : bool
        Whether each iteration returns the newest track of an object that was not read yet, or the newest features, and
        passes over older ones: for a program that reacts, and is slower than the pipeline.

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
    return Subscription(endpoint, channel, object=object, timeout=timeout, keys=keys, newest=newest)


def wait_until_running(endpoint: str, keys: str = "", seconds: float = REPORT_SECONDS) -> Endpoint:
    """Wait for a health report of the pipeline, and return its endpoint; tracks and models may pause for long.

    SilenceError if no report arrives in time, ServiceError if the pipeline has ended, or as for `subscribe`.
    """
    with Subscription[Health](endpoint, "health", timeout=seconds, keys=keys) as reports:
        if next(reports, None) is None or reports.place is None:
            reason = reports.end.reason if reports.end is not None else "it has no place"
            raise ServiceError(f"{endpoint or 'the pipeline'} does not run: {reason}")
        return reports.place
