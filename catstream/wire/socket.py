"""The sockets of all channels: context, limits, connection events, keys, and the check of messages.

Every queue, message and handshake has a limit. A frame that is not a message of the channel is counted, logged once and
dropped. If the endpoint has keys, everything is encrypted (CURVE), and a peer that connects needs a key with the role
of the channel: `_ZapHandler` decides.
"""

from __future__ import annotations

import atexit
import itertools
import logging
import os
import struct
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from enum import Enum
from functools import cache
from typing import Any, Generic, Self, TypeVar
from weakref import WeakSet

import zmq
import zmq.utils.garbage  # with the first message that is not copied, zmq would import it
from zmq.utils import z85

from catstream.errors import ProtocolError, ServiceError
from catstream.wire.channels import Channel
from catstream.wire.codec import decode_with_run, encode
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import ROLES, Keys

LINGER_SECONDS = 2.0  #: that a closed socket still has to transmit its last messages
RECONNECT_MOST_SECONDS = 0.5  #: between two attempts to connect again
KEEPALIVE_SECONDS = 5  #: without traffic, after which TCP probes the other host
KEEPALIVE_PROBE_SECONDS = 2  #: between two probes
KEEPALIVE_PROBES = 3  #: without an answer, after which the connection is closed

#: No ZeroMQ heartbeats: libzmq aborts the process if one is due to a peer that disconnected while its queue was full
#: (libzmq issue 4767). On one machine the kernel reports that a peer has ended. If a host loses its power, TCP
#: keepalive reports it after 11 s, or once the host is up again.
_OPTIONS = {
    zmq.LINGER: round(LINGER_SECONDS * 1000),
    zmq.HANDSHAKE_IVL: 5000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: KEEPALIVE_SECONDS,
    zmq.TCP_KEEPALIVE_INTVL: KEEPALIVE_PROBE_SECONDS,
    zmq.TCP_KEEPALIVE_CNT: KEEPALIVE_PROBES,
    zmq.RECONNECT_IVL: 20,  # before the first attempt to connect again; doubled each time
    zmq.RECONNECT_IVL_MAX: round(RECONNECT_MOST_SECONDS * 1000),
}

_POLLIN = int(zmq.POLLIN)  # an operation with a member of an enumeration would take half as long as to look
_MOST_CAUSES = 1024  # causes of rejects that are remembered; each is logged once

_log = logging.getLogger(__name__)

Message = TypeVar("Message")
Kind = TypeVar("Kind")

_OPEN: WeakSet[ChannelSocket[Any]] = WeakSet()  # sockets that were not closed yet
_lock = threading.Lock()  # the ZAP handler has a thread of its own
_counts: Counter[str] = Counter()
_logged: set[tuple[str, str]] = set()


@cache
def context() -> zmq.Context[zmq.Socket[bytes]]:
    """The ZeroMQ context of catstream in this process; only the limit of open files limits its number of sockets."""
    made = zmq.Context()
    made.set(zmq.MAX_SOCKETS, made.get(zmq.SOCKET_LIMIT))
    return made


def check_owner(owner: int) -> None:
    """Raise ServiceError in a copy of the process that made a connection: a fork copies no thread of ZeroMQ."""
    if owner != os.getpid():
        raise ServiceError(
            f"process {owner} has made it, and this one is a copy of that (fork), without its connections: subscribe, "
            "connect or start a pipeline in the process that uses it"
        )


def arrives(socket: zmq.Socket[bytes], seconds: float) -> bool:
    """Whether a socket has a message, or gets one within so many seconds."""
    # To look costs half as much as `poll`, and most sockets that are looked at have no message.
    has_message = int(socket.get(zmq.EVENTS)) & _POLLIN != 0
    return has_message or (seconds > 0 and bool(socket.poll(round(seconds * 1000))))


def reject(channel: str, cause: str, text: str) -> None:
    """Count a message or a connection that was rejected on a channel, and log it unless its cause was logged before."""
    with _lock:
        _counts["rejected"] += 1
        known = (channel, cause) in _logged
        if len(_logged) >= _MOST_CAUSES:
            _logged.clear()
        _logged.add((channel, cause))
    if not known:
        _log.warning("%s: %s", channel, text)


def rejects() -> dict[str, float]:
    """How many messages and connections this process has rejected, and how many connections ended, for its health."""
    return {name: float(_counts[name]) for name in ("rejected", "disconnected")}


class Event(Enum):
    """What ZeroMQ reports of a connection."""

    STOPPED = "the socket is closed: nothing is reported after it"
    CONNECTED = "the handshake succeeded"
    DISCONNECTED = "a connection ended"
    DENIED = "the handshake failed: the key was denied (ZAP status 400)"
    OTHER_MECHANISM = "the handshake failed: one side has keys, the other has none"
    FAILED = "the handshake failed for another reason"


_EVENTS = {
    zmq.EVENT_MONITOR_STOPPED: Event.STOPPED,
    zmq.EVENT_HANDSHAKE_SUCCEEDED: Event.CONNECTED,
    zmq.EVENT_DISCONNECTED: Event.DISCONNECTED,
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: Event.DENIED,
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: Event.FAILED,
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: Event.FAILED,
}
_MECHANISM_MISMATCH = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH


class Monitor:
    """Receives the connection events of one socket.

    libzmq's I/O thread blocks if a monitor is not read, or has no reader any more: so the queue has no limit, and a
    socket that listens is drained until the event `STOPPED` before its monitor is closed.
    """

    _numbers = itertools.count(1)  # a closed monitor keeps its address a little longer: each gets a new one

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        address = f"inproc://events-{next(self._numbers)}"
        self._events: zmq.Socket[bytes] = socket.context.socket(zmq.PAIR)  # first: nothing is reported without it
        self._events.set(zmq.RCVHWM, 0)
        try:
            socket.monitor(address, sum(_EVENTS))
        except zmq.ZMQError:
            self._events.close()
            raise
        self._events.connect(address)

    def events(self, seconds: float) -> Iterator[Event]:
        """The events that are here, and those that come within so many seconds of the one before."""
        while not self._events.closed and arrives(self._events, seconds):
            report, _ = self._events.recv_multipart()  # and the address of the other end
            kind, value = struct.unpack("=Hi", report)
            event = _EVENTS[kind]
            yield Event.OTHER_MECHANISM if event is Event.FAILED and value == _MECHANISM_MISMATCH else event

    def close(self) -> None:
        self._events.close()


class _ZapHandler:
    """Decides which peers may connect to the sockets of this process that listen, if the pipeline has keys.

    libzmq asks once for each connection, before it reads a message of it, by its protocol ZAP (RFC 27). A question
    names the socket, as a "domain", and the peer's public key; the peer has proved by then that it holds the secret
    one. The list of clients is read for each question, so no process has to be restarted if a client is allowed or
    revoked. A connection that is open stays open. A thread answers while a socket is registered.

    pyzmq's own handler, `zmq.auth`, is not used: see docs/decisions/0023-roles.md.
    """

    _address = "inproc://zeromq.zap.01"

    def __init__(self) -> None:
        self._sockets: dict[bytes, tuple[Channel[object], Keys]] = {}  # by domain
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def register(self, channel: Channel[object], keys: Keys) -> bytes:
        """Register a socket that listens; returns its domain."""
        with self._lock:
            domain = f"{channel.name} {next(self._numbers)}".encode()
            self._sockets[domain] = channel, keys
            if self._thread is None:
                socket = context().socket(zmq.REP)
                socket.bind(self._address)
                self._thread = threading.Thread(target=self._serve, args=(socket,), name="zap", daemon=True)
                self._thread.start()
        return domain

    def unregister(self, domain: bytes) -> None:
        with self._lock:
            self._sockets.pop(domain, None)
            if self._thread is not None and not self._sockets:
                with context().socket(zmq.REQ) as last:
                    last.connect(self._address)
                    last.send(b"")
                    self._thread.join()
                self._thread = None

    def _serve(self, socket: zmq.Socket[bytes]) -> None:
        with socket:
            while len(question := socket.recv_multipart()) > 1:
                _, request, domain, address, _, mechanism, *credentials = question
                status = self._status(domain, address.decode(errors="replace"), mechanism, credentials)
                socket.send_multipart([b"1.0", request, status, b"", b"", b""])
            socket.unbind(self._address)  # at once, for the next thread: libzmq closes some time later

    def _status(self, domain: bytes, address: str, mechanism: bytes, credentials: list[bytes]) -> bytes:
        """The status that lets a peer connect (200), try again later (300), or not (400)."""
        if domain not in self._sockets or mechanism != b"CURVE":
            return b"400"
        channel, keys = self._sockets[domain]
        public = z85.encode(credentials[0]).decode()
        try:
            client = keys.client(public)
        except ServiceError as error:
            reject(channel.name, str(error), f"nobody can connect: {error}")
            return b"300"
        if client is None:
            reject(channel.name, public, f"{address} was rejected, its key {public} is not allowed")
            return b"400"
        name, role = client
        if ROLES.index(role) < ROLES.index(channel.role):
            text = f"{name} at {address} was rejected, its role is {role} and not {channel.role}"
            reject(channel.name, public, text)
            return b"400"
        return b"200"


#: The handler of this process: libzmq asks one for each context.
_ZAP = _ZapHandler()


def _begin_copy() -> None:
    """Begin without the context and the threads of the process of which this one is a copy."""
    global _ZAP, _lock
    context.cache_clear()
    _lock = threading.Lock()
    _OPEN.clear()
    _ZAP = _ZapHandler()


os.register_at_fork(after_in_child=_begin_copy)


def _too_many(error: zmq.ZMQError) -> ServiceError:
    """The error for a socket that ZeroMQ could not make: it has its files, and those of its monitor."""
    return ServiceError(
        f"cannot open a socket ({error.strerror}): close the subscriptions and pipelines that are not needed, "
        "or raise the limit of open files (ulimit -n)"
    )


@atexit.register
def _transmit_rest() -> None:
    """Wait until ZeroMQ's thread has transmitted what closed sockets have queued: its memory is freed at the exit."""
    if not _OPEN:
        context().term()


class ChannelSocket(Generic[Message]):
    """One ZeroMQ socket of a channel, of one of ZeroMQ's kinds; it queues `high_water_mark` messages for each peer.

    run  id of the run that the last message is from, see `catstream.wire.codec`; empty if it is not known
    """

    def __init__(self, kind: int, channel: Channel[Message], endpoint: Endpoint, high_water_mark: int) -> None:
        self.channel = channel
        self.run = ""
        self._endpoint = endpoint
        self._listens = False
        self._domain = b""  # name of this socket for ZAP, if it listens and there are keys
        self._monitor: Monitor | None = None
        self._pid = os.getpid()
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
        """Readable if something may have arrived since this socket was last asked for a message."""
        return int(self._socket.get(zmq.FD))

    def close(self) -> None:
        """Transmit what is queued, then close; the address is free for the next socket."""
        if self._pid != os.getpid():  # a copy in a process that was forked, which lacks ZeroMQ's threads
            return
        if self._listens:
            self._socket.close()
            # libzmq stops listening some time later, and would remove the socket file of the next one with its own.
            # Unbinding first would be faster, but drops queued messages.
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
                self._domain = _ZAP.register(self.channel, keys)
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
            self._reject("message", f"a message was dropped: {error}")
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

    def _reject(self, cause: str, text: str) -> None:
        """Count a message that is not what the channel carries, and log it once for each cause."""
        reject(self.channel.name, cause, text)

    def _read_events(self, seconds: float = 0.0, until: Event | None = None) -> None:
        """Handle what was reported about connections; wait so long for each event, until a certain one.

        ServiceError if this side connects and is denied, or in a copy of the process.
        """
        check_owner(self._pid)
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
        """A connection began."""

    def _disconnected(self) -> None:
        """A connection ended."""
        if self._listens:
            _counts["disconnected"] += 1

    def _handshake_failed(self, event: Event) -> None:
        """Count a peer that failed; a key that was denied is counted by the ZAP handler already. Or raise the cause."""
        keys = self._endpoint.keys
        if self._listens and event is not Event.DENIED:
            other = "does not speak ZeroMQ" if keys is None else "lacks the pipeline's keys"
            reject(self.channel.name, "handshake", f"a peer has failed the handshake: it has ended, or it {other}")
        elif event is Event.DENIED and not self._listens:
            raise ServiceError(
                f"{self._endpoint} rejects this key: it was revoked, was never allowed, or lacks the role "
                f"{self.channel.role}, which {self.channel.name} requires; the pipeline's log says which: "
                "ask its administrator (catstream keys allow)"
            )
        elif event is Event.OTHER_MECHANISM and not self._listens and keys is None:
            raise ServiceError(
                f"the pipeline at {self._endpoint} requires authentication: pass a folder of keys that it allows "
                "(--keys DIR, see catstream keys)"
            )
