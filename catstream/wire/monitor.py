"""The connection events that ZeroMQ reports for a socket."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import NamedTuple

import zmq

__all__ = ["Event", "Monitor"]

_REPORTED = (
    zmq.EVENT_MONITOR_STOPPED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)

#: The first frame of a report. zmq.utils.monitor reads it, too, but imports asyncio, in 20 ms.
_REPORT = struct.Struct("=Hi")

#: ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH: one side has keys, the other has none.
_OTHER_MECHANISM = 0x11000002

_NUMBERS = itertools.count(1)  # a closed monitor keeps its address a little longer: each gets a new one


class Event(NamedTuple):
    """One event of a connection."""

    kind: int
    value: int

    @property
    def stopped(self) -> bool:
        """Whether the socket is closed: nothing is reported after it."""
        return self.kind == zmq.EVENT_MONITOR_STOPPED

    @property
    def disconnected(self) -> bool:
        """Whether a connection ended."""
        return self.kind == zmq.EVENT_DISCONNECTED

    @property
    def denied(self) -> bool:
        """Whether a key was denied (ZAP status 400)."""
        return self.kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH

    @property
    def other_mechanism(self) -> bool:
        """Whether the handshake failed because only one side has keys."""
        return self.kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL and self.value == _OTHER_MECHANISM


class Monitor:
    """Receives the events of one socket.

    libzmq's I/O thread blocks if a monitor is not read, or has no reader any more: so the queue has no limit, and a
    socket that listens is drained until the event `stopped` before its monitor is closed.
    """

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        address = f"inproc://events-{next(_NUMBERS)}"
        socket.monitor(address, _REPORTED)
        self._events: zmq.Socket[bytes] = socket.context.socket(zmq.PAIR)
        self._events.set(zmq.RCVHWM, 0)
        self._events.connect(address)

    def events(self, milliseconds: int = 0) -> Iterator[Event]:
        """The events that are here, and those that come within so many milliseconds of the one before."""
        while not self._events.closed and self._events.poll(milliseconds):
            report, _ = self._events.recv_multipart()  # and the address of the other end
            yield Event(*_REPORT.unpack(report))

    def close(self) -> None:
        """Close the monitor socket."""
        self._events.close()
