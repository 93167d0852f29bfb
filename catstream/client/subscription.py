"""The messages of a running pipeline, for `catstream.subscribe`.

The pipeline never waits for a subscriber. A slow subscriber misses tracks, and `missed` counts them; `behind` is the
age of the last one, and with `newest=True` older ones are skipped. With `object="anna"`, only the messages about
this object are transmitted.
"""

from __future__ import annotations

import threading
from contextlib import ExitStack
from functools import partial
from time import monotonic
from typing import Any, Generic, Self, TypeVar, cast

import zmq

from catstream.base.clock import RunningClock
from catstream.base.forks import check_not_forked, generation
from catstream.base.names import check_name
from catstream.errors import ServiceError, SilenceError
from catstream.wire.channels import HEALTH, PUBLIC, TRACKS, Channel
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Features, Health, Track, run_state
from catstream.wire.newest import GapCounter, Subscriber

CHECK_SECONDS = 0.2  #: interval of the checks for rejected keys, removed sockets and a moved stream
REASON_SECONDS = 2.0  #: last part of a timeout, in which a health report is awaited for the reason
DRAIN_SECONDS = 0.5  #: wait for messages that were overtaken by the end, which has its own connection

Message = TypeVar("Message")


class _Connection:
    """The sockets of a subscription to one pipeline, and the content of the health reports of its detector.

    read    time of the frame that was read last
    newest  time of the newest frame, by the reports
    state   of the run in words, by the reports; empty if there was none
    """

    def __init__(self, channel: Channel[Any], about: str | None, newest: bool, endpoint: Endpoint) -> None:
        only = None if about is None else channel.messages[0]
        self.endpoint, self._about = endpoint, about
        self.read = self.newest = 0.0
        self.state = ""
        self._health: Subscriber[Health] | None = None
        with ExitStack() as stack:
            messages = Subscriber[Any](channel, endpoint, only, about=about, newest=newest)
            self.messages = stack.enter_context(messages)
            # The end has its own socket: a slow subscriber could miss it among the dropped messages.
            self.ends: Subscriber[Any] = Subscriber(TRACKS, endpoint, only=End)
            stack.pop_all()

    def receive_health(self) -> None:
        """Process the reports that have arrived; the first call connects, and the last report arrives at once."""
        self._health = self._health or Subscriber(HEALTH, self.endpoint)
        for report in self._health.receive_all():
            if report.process == "detector":
                self.newest, self.state = report.counters.get("time", self.newest), run_state(report.counters)[1]
                if self._about is not None and self._about not in report.objects:
                    self.state += f", without an object {self._about!r}"

    def close(self) -> None:
        for socket in (self.messages, self.ends, self._health):
            if socket is not None:
                socket.close()


class Subscription(Generic[Message]):
    """The messages of one channel of a running pipeline, until the pipeline ends; iterate with `for` or `async for`.

    There is one features message for each frame, and one track for each object and frame; after a restart of the
    detector some are repeated. Of models, samples, previews and health reports, the last ones arrive at once; then each
    iteration returns the newest, and older ones that were not read are dropped. Models and samples are kept for each
    object, and the object that has waited longest comes first. With `newest`, the same holds for tracks and features.

    `catstream.subscribe` makes one, and documents the parameters.

    Attributes
    ----------
    end : End or None
        The last message of the pipeline, or the reason why there is none; None before that.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`; it may continue afterwards. With a
        timeout of two seconds or more, the error says whether the run is paused, waits for a box or has lost its
        source.

    Raises
    ------
    SilenceError
        During iteration, if no message arrived within `timeout`.
    ServiceError
        During iteration, if the pipeline rejects the keys, or the subscription is closed.
    """

    def __init__(
        self,
        endpoint: Endpoint | None,
        channel: str,
        *,
        object: str | None = None,
        timeout: float | None = None,
        newest: bool = False,
    ) -> None:
        if channel not in PUBLIC:
            raise ServiceError(f"unknown channel {channel!r}: subscribe to one of {', '.join(PUBLIC)}")
        self._channel = PUBLIC[channel]
        if object is not None and not self._channel.by_object:
            names = ", ".join(name for name, row in PUBLIC.items() if row.by_object)
            raise ServiceError(
                f"a message of {channel} is about all objects: subscribe to {names} for one object, or to {channel} "
                "without an object"
            )
        self.timeout = timeout
        self.end: End | None = None
        self._gaps = GapCounter(of_one_object=object is not None)
        self._open = partial(_Connection, self._channel, None if object is None else check_name(object), newest)
        self._connection: _Connection | None = None
        self._close_time = float("inf")  # end of the wait for overtaken messages
        self._is_over = False  # True once all messages before the end were returned
        self._clock = RunningClock()  # of the timeout
        self._has_run = endpoint is not None and not endpoint.lacks_sockets()  # whether the pipeline has been running
        self._closed = False
        self._generation = generation()
        self._lock = threading.RLock()  # a thread or a signal handler may close while another thread waits
        if endpoint is not None:
            self._connect(endpoint)

    @property
    def endpoint(self) -> Endpoint | None:
        """Endpoint of the pipeline; None if the stream of a fleet has not run yet."""
        return self._connection.endpoint if self._connection is not None else None

    @property
    def missed(self) -> int:
        """Number of frames whose tracks or features were not received, or were skipped.

        Frames of one object count between its first and its last frame.
        """
        return self._gaps.missed + self._gaps.before

    def losses(self) -> str:
        """Describe the missed messages in words."""
        before = f", {self._gaps.before} of them before this subscriber connected" if self._gaps.before else ""
        return f"{self.missed} missed{before}"

    @property
    def behind(self) -> float:
        """Age of the track or features that were read last: seconds of the source from their frame to the newest one.

        It is computed from the health reports of the pipeline, one a second, which are received from the first call on;
        0 before the first report, and on other channels.
        """
        with self._lock:
            if self._connection is None or self._channel.keeps != "every":
                return 0.0
            self._connection.receive_health()
            return max(0.0, self._connection.newest - self._connection.read)

    @property
    def run(self) -> str:
        """Id of the run that sent the last message; each start of a pipeline is a run. Empty if unknown."""
        return self._connection.messages.run if self._connection is not None else ""

    def close(self) -> None:
        """Disconnect. Iteration in another thread or task raises a ServiceError soon after."""
        self._closed = True
        with self._lock:
            if self._connection is not None:
                self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Message:
        deadline = self._deadline()
        while (message := self._next_message(deadline)) is None:
            if self._is_over:
                raise StopIteration
            self._poller(zmq.Poller()).poll(self._milliseconds(deadline))
        return message

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Message:
        import zmq.asyncio  # takes a tenth of a second, with asyncio

        deadline = self._deadline()
        while (message := self._next_message(deadline)) is None:
            if self._is_over:
                raise StopAsyncIteration
            await self._poller(zmq.asyncio.Poller()).poll(self._milliseconds(deadline))
        return message

    def _deadline(self) -> float:
        """The end of the timeout of the next message."""
        if self._connection is not None:
            self._connection.state = ""
        return float("inf") if self.timeout is None else self._clock() + self.timeout

    def _poller(self, poller: Any) -> Any:
        """Register the descriptors of the sockets, which another thread may close meanwhile."""
        with self._lock:
            if self._connection is not None and not self._closed:
                for socket in (self._connection.messages, self._connection.ends):
                    poller.register(socket.fileno(), zmq.POLLIN)
        return poller

    def _milliseconds(self, deadline: float) -> float:
        """The time to wait for the sockets."""
        remaining = self._close_time - monotonic() if self.end is not None else deadline - self._clock()
        return 1000 * max(0.0, min(remaining, CHECK_SECONDS))

    def _next_message(self, deadline: float) -> Message | None:
        """The next message if one has arrived, without waiting; also runs periodic housekeeping."""
        check_not_forked(self._generation)  # first: another thread may have held the lock during the fork
        with self._lock:
            if self._closed:
                raise ServiceError("the subscription is closed (perhaps by another thread or task): create a new one")
            is_late = monotonic() >= self._close_time  # read before the sockets, as this thread may be suspended
            if (message := self._receive()) is not None:
                self._has_run = True
                return message
            if is_late and self.end is not None:
                self._is_over = True
                if self._channel.keeps == "every":
                    self._gaps.end(self.end)  # earlier frames that have not arrived are missed
            if self.end is None:
                self._look_for_pipeline()
            if self.end is None:
                self._check_timeout(deadline - self._clock())
            return None

    def _receive(self) -> Message | None:
        """The next message if one has arrived; records the end of the pipeline."""
        if (connection := self._connection) is None:
            return None
        connection.ends.pending()  # ZeroMQ subscribes to a restarted pipeline only while the socket is polled
        while (message := connection.messages.receive(0)) is not None:
            if not isinstance(message, End):
                if isinstance(message, Track | Features):
                    self._gaps.take(message, self.run)
                    connection.read = message.time
                return cast(Message, message)
            if self._channel.keeps == "every":  # the last message here
                self._pipeline_ended(message, 0.0)
        if self.end is None and (end := connection.ends.receive(0)) is not None:
            self._pipeline_ended(end, DRAIN_SECONDS)
        return None

    def _check_timeout(self, remaining: float) -> None:
        """Raise SilenceError if no time remains; shortly before, receive health reports for the reason."""
        if (self.timeout or 0.0) >= REASON_SECONDS > remaining and self._connection and self._channel is not HEALTH:
            self._connection.receive_health()
        if remaining <= 0:
            source = f" from {self.endpoint}" if self.endpoint is not None else ""
            raise SilenceError(f"no {self._channel.name} arrived{source} within {self.timeout:g} s: {self._silence()}")

    def _silence(self) -> str:
        """The reason why no message arrives, if it is known."""
        if self._connection is not None and self._connection.state:
            return f"the state of the pipeline is: {self._connection.state}"
        return self.endpoint.hint() if self.endpoint is not None else "is a pipeline running there?"

    def _pipeline_ended(self, end: End, seconds: float) -> None:
        """Record the end; the wait for overtaken messages lasts `seconds`."""
        self.end, self._close_time = end, monotonic() + seconds

    def _look_for_pipeline(self) -> None:
        """End if the pipeline has removed its sockets, which is its last step.

        A subscriber that has not read since a restart is not subscribed any more, and misses the end.
        """
        if self.endpoint is not None and not self.endpoint.lacks_sockets():
            self._has_run = True
        elif self._has_run:
            gone = "its sockets were removed, and this subscriber did not receive its end"
            self._pipeline_ended(End(0, gone), DRAIN_SECONDS)

    def _connect(self, endpoint: Endpoint) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = self._open(endpoint)
