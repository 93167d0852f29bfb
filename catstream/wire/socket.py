"""The base class of all sockets of a channel: limits, keys, connection events, and the check of messages.

Every queue, message and handshake has a limit. A frame that is not a message of the channel is counted, logged
once and dropped (`catstream.wire.rejects`). If the endpoint has keys, everything is encrypted (CURVE), and a peer that
connects needs a key with the role of the channel (`catstream.wire.zap`).
"""

from __future__ import annotations

import atexit
import os
import warnings
from collections.abc import Callable
from typing import Any, Generic, Self, TypeVar
from weakref import WeakSet

import zmq

from catstream.errors import ProtocolError, ServiceError
from catstream.wire import timing
from catstream.wire.channels import Channel
from catstream.wire.codec import decode_with_run, encode
from catstream.wire.context import arrives, context
from catstream.wire.endpoint import Endpoint
from catstream.wire.monitor import Event, Monitor
from catstream.wire.rejects import count, reject
from catstream.wire.zap import ZAP


def _milliseconds(seconds: float) -> int:
    return round(seconds * 1000)


#: No ZeroMQ heartbeats: libzmq aborts the process if one is due to a peer that disconnected while its queue was full
#: (libzmq issue 4767). On one machine the kernel reports that a peer has ended. If a host loses its power, TCP
#: keepalive reports it after 11 s, or once the host is up again.
_OPTIONS = {
    zmq.LINGER: _milliseconds(timing.LINGER_SECONDS),
    zmq.HANDSHAKE_IVL: _milliseconds(timing.HANDSHAKE_SECONDS),
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: round(timing.KEEPALIVE_SECONDS),
    zmq.TCP_KEEPALIVE_INTVL: round(timing.KEEPALIVE_PROBE_SECONDS),
    zmq.TCP_KEEPALIVE_CNT: timing.KEEPALIVE_PROBES,
    zmq.RECONNECT_IVL: _milliseconds(timing.RECONNECT_SECONDS),
    zmq.RECONNECT_IVL_MAX: _milliseconds(timing.RECONNECT_MOST_SECONDS),
}

Message = TypeVar("Message")
Kind = TypeVar("Kind")

_OPEN: WeakSet[ChannelSocket[Any]] = WeakSet()  # sockets that were not closed yet


def _too_many(error: zmq.ZMQError) -> ServiceError:
    """The error for a socket that ZeroMQ could not make: it has its files, and those of its monitor."""
    return ServiceError(
        f"cannot open a socket ({error.strerror}): close the subscriptions and pipelines that are not needed, "
        "or raise the limit of open files (ulimit -n)"
    )


@atexit.register
def _transmit_rest() -> None:
    """Wait until the messages that closed sockets have queued are transmitted, at most `LINGER_SECONDS`.

    They are transmitted by a thread of ZeroMQ from the memory of Python, which is freed when the process ends.
    """
    if not _OPEN:
        context().term()


class ChannelSocket(Generic[Message]):
    """One ZeroMQ socket of a channel.

    Parameters
    ----------
    kind : of ZeroMQ's socket types
    high_water_mark : messages that are queued for each peer at most

    Attributes
    ----------
    channel : row of the table
    rejected : messages that were dropped because they were not what the channel carries
    run : id of the run that the last message is from, see `catstream.wire.codec`; empty if it is not known
    """

    def __init__(self, kind: int, channel: Channel[Message], endpoint: Endpoint, high_water_mark: int) -> None:
        self.channel = channel
        self.rejected = 0
        self.run = ""
        self._endpoint = endpoint
        self._listens = False
        self._domain = b""  # name of this socket for ZAP, if it listens and there are keys
        self._monitor: Monitor | None = None
        try:
            self._socket: zmq.Socket[bytes] = context().socket(kind)
        except zmq.ZMQError as error:
            raise _too_many(error) from None
        _OPEN.add(self)
        self._pid = os.getpid()
        for option, value in _OPTIONS.items():
            self._socket.set(option, value)
        self._socket.set(zmq.IPV6, int("[" in str(endpoint)))
        self._socket.set(zmq.SNDHWM, high_water_mark)
        self._socket.set(zmq.RCVHWM, high_water_mark)
        self._socket.set(zmq.MAXMSGSIZE, channel.limit)

    def fileno(self) -> int:
        """Readable if something may have arrived since this socket was last asked for a message."""
        return int(self._socket.get(zmq.FD))

    def close(self) -> None:
        """Transmit what is queued, then close; the address is free for the next socket."""
        _OPEN.discard(self)
        if self._pid != os.getpid():  # a copy in a process that was forked, which lacks ZeroMQ's threads
            return
        if self._listens:
            self._socket.close()
            # libzmq stops listening some time later, and would remove the socket file of the next one with its own.
            # Unbinding first would be faster, but drops queued messages.
            self._read_events(2 * timing.LINGER_SECONDS, until=Event.STOPPED)
            self._listens = False
        elif not self._socket.closed:
            self._socket.disable_monitor()
            self._socket.close()
        if self._monitor is not None:
            self._monitor.close()
        if self._domain:
            ZAP.unregister(self._domain)
            self._domain = b""

    def __del__(self) -> None:
        # The monitor of a socket that was dropped has no reader any more, and would block ZeroMQ's thread: nothing more
        # would arrive at any socket of this program.
        socket = getattr(self, "_socket", None)
        if socket is not None and not socket.closed and self._pid == os.getpid():
            socket.disable_monitor()
            socket.close()
            if self._monitor is not None:
                self._monitor.close()
            warnings.warn("a subscription or control was not closed: use it in a `with`", ResourceWarning, stacklevel=1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _bind(self, sender: str | None = None) -> None:
        address = self._endpoint.listening(self.channel, sender)
        keys = self._endpoint.keys
        try:
            if keys is not None:
                self._socket.set(zmq.CURVE_SECRETKEY, keys.listening())
                self._socket.set(zmq.CURVE_SERVER, 1)
                self._domain = ZAP.register(self.channel, keys)
                self._socket.set(zmq.ZAP_DOMAIN, self._domain)
                self._socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without a ZAP handler nobody may connect
            if self._endpoint.taken(self.channel, sender):
                raise zmq.ZMQError(zmq.EADDRINUSE)
            self._monitor = Monitor(self._socket)
            self._socket.bind(address)
            self._listens = True
        except zmq.ZMQError as error:
            self.close()
            raise ServiceError(
                f"cannot listen on {address} ({error.strerror}): another pipeline may be running there, "
                "wait for it or give another endpoint (--set run.endpoint=...)"
            ) from None
        except ServiceError:
            self.close()
            raise

    def _connect(self) -> None:
        if (keys := self._endpoint.keys) is not None:
            self._socket.set(zmq.CURVE_SERVERKEY, keys.server)
            self._socket.set(zmq.CURVE_PUBLICKEY, keys.public)
            self._socket.set(zmq.CURVE_SECRETKEY, keys.secret)
        try:
            self._monitor = Monitor(self._socket)
        except zmq.ZMQError as error:
            self.close()
            raise _too_many(error) from None
        for sender in self.channel.senders:
            self._socket.connect(self._endpoint.address(self.channel, sender))

    def pending(self) -> bool:
        """Whether something has arrived that was not received yet."""
        return self._wait(0)

    def _wait(self, seconds: float) -> bool:
        """Whether something arrives within so many seconds; handles the events of connections first."""
        self._read_events()
        return arrives(self._socket, seconds)

    def _decode(
        self, data: bytes | memoryview, *kinds: type[Kind], check: Callable[[Kind], None] | None = None
    ) -> Kind | None:
        """The message in `data`, None if it is rejected."""
        try:
            message, self.run = decode_with_run(data, *kinds)
            if check is not None:
                check(message)
        except ProtocolError as error:
            self._reject(error.reason, f"a message was dropped: {error}")
            return None
        return message

    def _encode(self, message: object) -> bytes:
        """A message of this process as bytes."""
        return encode(message, self._endpoint.run)

    def _receive_from_peer(self) -> tuple[bytes, memoryview | None]:
        """Peer and data of a ROUTER's next message; the data is None if the message has not exactly one part."""
        peer = self._socket.recv()
        data = self._socket.recv(copy=False).buffer
        parts = 1
        while self._socket.get(zmq.RCVMORE):  # one by one: a peer may send any number
            self._socket.recv(copy=False)
            parts += 1
        if parts > 1:
            self._reject("parts", f"a message was dropped: it has {parts} parts")
            return peer, None
        return peer, data

    def _reject(self, reason: str, text: str) -> None:
        """Count a message that is not what the channel carries, and log it once."""
        self.rejected += 1
        reject(self.channel.name, reason, text)

    def _read_events(self, seconds: float = 0.0, until: Event | None = None) -> None:
        """Handle what was reported about connections; wait so long for each event, until a certain one.

        Raises
        ------
        ServiceError
            If this side connects and is denied: its key lacks the role, or it has none and the pipeline asks for some.
        """
        if self._monitor is None:
            return
        for event in self._monitor.events(seconds):
            if event is Event.DISCONNECTED:
                self._disconnected()
            elif self._listens:
                self._failed_to_connect(event)
            else:
                self._raise_if_denied(event)
            if event is until:
                break

    def _disconnected(self) -> None:
        """A connection ended."""
        if self._listens:
            count("disconnected")

    def _failed_to_connect(self, event: Event) -> None:
        """A peer failed the handshake; a key that was denied is counted by the ZAP handler already."""
        if event in (Event.OTHER_MECHANISM, Event.FAILED):
            other = "does not speak ZeroMQ" if self._endpoint.keys is None else "lacks the pipeline's keys"
            reject(self.channel.name, "handshake", f"a peer has failed the handshake: it has ended, or it {other}")

    def _raise_if_denied(self, event: Event) -> None:
        if event is Event.DENIED:
            raise ServiceError(
                f"{self._endpoint} rejects this key: it was revoked, was never allowed, or lacks the role "
                f"{self.channel.role}, which {self.channel.name} requires; the pipeline's log says which: "
                "ask its administrator (catstream keys allow)"
            )
        if event is Event.OTHER_MECHANISM and self._endpoint.keys is None:
            raise ServiceError(
                f"the pipeline at {self._endpoint} requires authentication: pass a folder of keys that it allows "
                "(--keys DIR, see catstream keys)"
            )
