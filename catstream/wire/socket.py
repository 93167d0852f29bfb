"""The base class of the sockets of all channels: context, limits, keys, and validation of messages.

Every queue, message and handshake has a limit. An invalid frame is counted, logged once and dropped. If the endpoint
has keys, all traffic is encrypted (CURVE), and a connecting peer needs a key with the role of the channel, which
`catstream.wire.zap` checks.
"""

from __future__ import annotations

import atexit
import errno
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, Generic, Self, TypeVar
from weakref import WeakSet

import zmq
import zmq.utils.garbage  # now, rather than with the first zero-copy message

from catstream.base.forks import after_fork, check_not_forked, forked, generation
from catstream.errors import ProtocolError, ServiceError
from catstream.wire.channels import Channel
from catstream.wire.codec import decode_with_run, encode
from catstream.wire.endpoint import Endpoint
from catstream.wire.monitor import Event, Monitor, arrives
from catstream.wire.rejects import reject
from catstream.wire.zap import ZapHandler

LINGER_SECONDS = 2.0  #: time for a closed socket to transmit its last messages
RECONNECT_MOST_SECONDS = 0.5  #: maximum interval between two attempts to reconnect
KEEPALIVE_SECONDS = 5  #: time without traffic after which TCP probes the other host
KEEPALIVE_PROBE_SECONDS = 2  #: interval between two probes
KEEPALIVE_PROBES = 3  #: unanswered probes after which the connection is closed

#: No ZeroMQ heartbeats: libzmq aborts the process when it sends one to a peer that disconnected with a full queue
#: (libzmq issue 4767). On one machine, the kernel reports that a peer has ended. If another host loses its power, TCP
#: keepalive detects it after 11 s, or once the host is up again.
_OPTIONS = {
    zmq.LINGER: round(LINGER_SECONDS * 1000),
    zmq.HANDSHAKE_IVL: 5000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: KEEPALIVE_SECONDS,
    zmq.TCP_KEEPALIVE_INTVL: KEEPALIVE_PROBE_SECONDS,
    zmq.TCP_KEEPALIVE_CNT: KEEPALIVE_PROBES,
    zmq.RECONNECT_IVL: 20,  # before the first attempt to reconnect; doubled each time
    zmq.RECONNECT_IVL_MAX: round(RECONNECT_MOST_SECONDS * 1000),
}

Message = TypeVar("Message")
Kind = TypeVar("Kind")

_OPEN: WeakSet[ChannelSocket[Any]] = WeakSet()  # sockets that were not closed yet
_ZAP = ZapHandler()  # ZAP handlers are per context


@cache
def context() -> zmq.Context[zmq.Socket[bytes]]:
    """The ZeroMQ context of catstream in this process; its sockets are limited only by the limit of open files."""
    context = zmq.Context()
    context.set(zmq.MAX_SOCKETS, context.get(zmq.SOCKET_LIMIT))
    return context


def _reset_after_fork() -> None:
    """Drop the ZeroMQ context and threads inherited through fork."""
    global _ZAP
    context.cache_clear()
    _OPEN.clear()
    _ZAP = ZapHandler()


after_fork(_reset_after_fork)


def _too_many(error: zmq.ZMQError) -> ServiceError:
    """The error for a socket that ZeroMQ could not create: each socket and its monitor use file descriptors."""
    return ServiceError(
        f"cannot open a socket ({error.strerror}): close unneeded subscriptions and pipelines, "
        "or raise the limit of open files (ulimit -n)"
    )


#: The advice if a socket cannot listen, by the error.
_REMEDIES = {
    errno.EADDRINUSE: "another pipeline may be running there: wait for it, or ",
    errno.ENOENT: "the folder does not exist: create it, or ",
    errno.EACCES: "this user may not write there: change the permissions, or ",
}


@atexit.register
def _flush() -> None:
    """Wait until ZeroMQ's thread has transmitted the queues of closed sockets, before their memory is freed."""
    if not _OPEN:
        context().term()


class ChannelSocket(Generic[Message]):
    """One ZeroMQ socket of a channel; `kind` is ZeroMQ's. It queues `high_water_mark` messages for each peer."""

    def __init__(self, kind: int, channel: Channel[Message], endpoint: Endpoint, high_water_mark: int) -> None:
        self.channel = channel
        self.run = ""  #: id of the run of the last message, see `catstream.wire.codec`; empty if unknown
        self._endpoint = endpoint
        self._listens = False
        self._domain = b""  # name of this socket for ZAP, if it listens and there are keys
        self._monitor: Monitor | None = None
        self._generation = generation()
        try:
            self._socket: zmq.Socket[bytes] = context().socket(kind)
        except zmq.ZMQError as error:
            raise _too_many(error) from None
        _OPEN.add(self)
        for option, value in _OPTIONS.items():
            self._socket.set(option, value)
        self._socket.set(zmq.IPV6, int(endpoint.is_ipv6))
        self._socket.set(zmq.SNDHWM, high_water_mark)
        self._socket.set(zmq.RCVHWM, high_water_mark)
        self._socket.set(zmq.MAXMSGSIZE, channel.limit)

    def fileno(self) -> int:
        """File descriptor that becomes readable if a message may have arrived since the last `receive`."""
        return int(self._socket.get(zmq.FD))

    def close(self) -> None:
        """Transmit queued messages, then close; the address is free for the next socket."""
        if forked(self._generation):  # this process lacks ZeroMQ's threads
            return
        if self._listens:
            self._socket.close()
            # libzmq stops listening asynchronously, and would then remove the socket file of a successor. Unbinding
            # first would be faster, but drops queued messages.
            self._read_events(2 * LINGER_SECONDS, until=Event.STOPPED)
            self._listens = False
        elif not self._socket.closed:
            self._socket.disable_monitor()
            self._socket.close()
        if self._monitor is not None:
            self._monitor.close()
        if self._domain:
            _ZAP.unregister(self._domain)
            self._domain = b""
        _OPEN.discard(self)

    def __del__(self) -> None:
        # The monitor of a garbage-collected socket has no reader, and would block ZeroMQ's thread: no socket of this
        # program would receive anything.
        socket = getattr(self, "_socket", None)
        if socket is not None and not socket.closed and not forked(self._generation):
            socket.disable_monitor()
            socket.close()
            if self._monitor is not None:
                self._monitor.close()
            warnings.warn("unclosed subscription or control: use it in a `with`", ResourceWarning, stacklevel=1)

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
                self._domain = _ZAP.register(context(), self.channel, keys)
                self._socket.set(zmq.ZAP_DOMAIN, self._domain)
                self._socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without a ZAP handler, all clients are rejected
            if self._endpoint.is_in_use(self.channel, sender):
                raise zmq.ZMQError(zmq.EADDRINUSE)
            self._monitor = Monitor(self._socket)
            self._socket.bind(address)
            self._listens = True
        except zmq.ZMQError as error:
            self.close()
            why = zmq.strerror(error.errno or 0)  # `error.strerror` repeats the address
            remedy = f"{_REMEDIES.get(error.errno or 0, '')}choose another endpoint (--set run.endpoint=...)"
            raise ServiceError(f"cannot listen on {address} ({why}): {remedy}") from None
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
        """Return True if a message has arrived that was not received yet."""
        return self._wait(0)

    def _wait(self, seconds: float) -> bool:
        """Handle connection events; return True if a message arrives within `seconds`."""
        self._read_events()
        return arrives(self._socket, seconds)

    def _decode(
        self, data: bytes | memoryview, *kinds: type[Kind], check: Callable[[Kind], None] | None = None
    ) -> Kind | None:
        """Decode a message; None if it is rejected."""
        try:
            message, self.run = decode_with_run(data, *kinds)
            if check is not None:
                check(message)
        except ProtocolError as error:
            self._reject("message", f"a message was dropped: {error}")
            return None
        return message

    def _encode(self, message: object) -> bytes:
        """Encode a message of this process."""
        return encode(message, self._endpoint.run)

    def _receive_from_peer(self) -> tuple[bytes, memoryview | None]:
        """Peer and data of a ROUTER's next message; the data is None unless the message has exactly one part."""
        peer = self._socket.recv()
        data = self._socket.recv(copy=False).buffer
        parts = 1
        while self._socket.get(zmq.RCVMORE):  # one by one: the number of parts has no limit
            self._socket.recv(copy=False)
            parts += 1
        if parts > 1:
            self._reject("parts", f"a message was dropped: it has {parts} parts")
            return peer, None
        return peer, data

    def _reject(self, cause: str, text: str) -> None:
        """Count an invalid message, and log it once for each cause."""
        reject(self.channel.name, cause, text)

    def _read_events(self, seconds: float = 0.0, until: Event | None = None) -> None:
        """Handle connection events; wait up to `seconds` for each, until the event `until`.

        ServiceError if this side connects and is denied, or in a forked process.
        """
        check_not_forked(self._generation)
        for event in self._monitor.events(seconds) if self._monitor is not None else ():
            if event is Event.CONNECTED:
                self._connected()
            elif event is Event.DISCONNECTED:
                self._disconnected()
            elif event is not Event.STOPPED:
                self._handshake_failed(event)
            if event is until:
                break

    def _connected(self) -> None:
        """Handle a new connection."""

    def _disconnected(self) -> None:
        """Handle the end of a connection."""

    def _handshake_failed(self, event: Event) -> None:
        """Count a failed handshake, unless the ZAP handler has counted it; as a client, raise an error if denied.

        A peer that left is counted only with keys: a peer without keys detects the mismatch first and leaves.
        """
        endpoint, keys = self._endpoint, self._endpoint.keys
        if self._listens:
            if event is not (Event.LEFT if keys is None else Event.DENIED):
                why = "does not speak ZeroMQ, or has keys" if keys is None else "has left, or lacks the pipeline's keys"
                reject(self.channel.name, "handshake", f"the handshake with a peer failed: it {why}")
        elif event is Event.DENIED:
            raise ServiceError(
                f"{endpoint} rejects the key in {keys and keys.folder}: it is not allowed, or lacks the role "
                f"{self.channel.role}, which {self.channel.name} requires; ask the administrator (catstream keys allow)"
            )
        elif event is Event.OTHER_MECHANISM:
            raise ServiceError(
                f"the pipeline at {endpoint} requires authentication: pass a folder of keys that it allows (--keys DIR)"
                if keys is None
                else f"the pipeline at {endpoint} has no keys: connect without keys (omit --keys)"
            )
