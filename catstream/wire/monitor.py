"""Events of the connections of a socket, as ZeroMQ reports them."""

from __future__ import annotations

import errno
import itertools
import struct
from collections.abc import Iterator
from enum import Enum

import zmq

_POLLIN = int(zmq.POLLIN)  # an operation with a member of an enumeration would take half as long as to look


class Event(Enum):
    """An event of a connection, as ZeroMQ reports it."""

    STOPPED = "the socket is closed: nothing is reported after it"
    CONNECTED = "the handshake succeeded"
    DISCONNECTED = "a connection ended"
    DENIED = "the handshake failed: the key was denied (ZAP status 400)"
    OTHER_MECHANISM = "the handshake failed: one side has keys, the other has none"
    LEFT = "the other end closed the connection during the handshake"
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
            yield _FAILURES.get(value, event) if event is Event.FAILED else event

    def close(self) -> None:
        self._events.close()


def arrives(socket: zmq.Socket[bytes], seconds: float) -> bool:
    """Return True if a socket has a message, or gets one within so many seconds."""
    # To look costs half as much as `poll`, and most sockets that are looked at have no message.
    has_message = int(socket.get(zmq.EVENTS)) & _POLLIN != 0
    return has_message or (seconds > 0 and bool(socket.poll(round(seconds * 1000))))
