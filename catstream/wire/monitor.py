"""Events of the connections of a socket, as ZeroMQ reports them."""

from __future__ import annotations

import errno
import itertools
import struct
from collections.abc import Iterator
from enum import Enum

import zmq

_POLLIN = int(zmq.POLLIN)  # operations on an enum's member are slow, compared with a check of a socket


class Event(Enum):
    """An event of a connection."""

    STOPPED = "the socket is closed: this is the last event"
    CONNECTED = "the handshake succeeded"
    DISCONNECTED = "a connection ended"
    DENIED = "the handshake failed: the key was denied (ZAP status 400)"
    OTHER_MECHANISM = "the handshake failed: only one side has keys"
    LEFT = "the peer closed the connection during the handshake"
    FAILED = "the handshake failed for another reason"


_EVENTS = {
    zmq.EVENT_MONITOR_STOPPED: Event.STOPPED,
    zmq.EVENT_HANDSHAKE_SUCCEEDED: Event.CONNECTED,
    zmq.EVENT_DISCONNECTED: Event.DISCONNECTED,
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: Event.DENIED,
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: Event.FAILED,
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: Event.FAILED,
}
_FAILURES = {
    errno.EPIPE: Event.LEFT,
    errno.ECONNRESET: Event.LEFT,
    0x11000002: Event.OTHER_MECHANISM,  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
}


class Monitor:
    """Receives the connection events of one socket.

    libzmq's I/O thread blocks on a full queue or a closed reader. Therefore the queue has no limit, and the events of a
    listening socket are read up to `STOPPED` before its monitor is closed.
    """

    _numbers = itertools.count(1)  # of addresses: each monitor gets a new one, as closing releases it only later

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        address = f"inproc://events-{next(self._numbers)}"
        self._events: zmq.Socket[bytes] = socket.context.socket(zmq.PAIR)  # created first, so no event is lost
        self._events.set(zmq.RCVHWM, 0)
        try:
            socket.monitor(address, sum(_EVENTS))
        except zmq.ZMQError:
            self._events.close()
            raise
        self._events.connect(address)

    def events(self, seconds: float) -> Iterator[Event]:
        """Yield events until no further one arrives within `seconds`."""
        while not self._events.closed and arrives(self._events, seconds):
            report, _ = self._events.recv_multipart()  # the second part is the peer's address
            kind, value = struct.unpack("=Hi", report)
            event = _EVENTS[kind]
            yield _FAILURES.get(value, event) if event is Event.FAILED else event

    def close(self) -> None:
        self._events.close()


def arrives(socket: zmq.Socket[bytes], seconds: float) -> bool:
    """Return True if a socket has a message, or receives one within `seconds`."""
    # Reading the option costs half as much as `poll`, and most sockets have no message.
    has_message = int(socket.get(zmq.EVENTS)) & _POLLIN != 0
    return has_message or (seconds > 0 and bool(socket.poll(round(seconds * 1000))))
