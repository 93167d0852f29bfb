"""Events of the connections of a socket, as ZeroMQ reports them, and a probe of a listener."""

from __future__ import annotations

import itertools
import socket as sockets
import struct
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from enum import Enum
from typing import TypeGuard
from urllib.parse import urlsplit

import zmq

_POLLIN = int(zmq.POLLIN)  # an operation with a member of an enumeration would take half as long as to look
_PROBE_SECONDS = 0.5  # limit for a listener to answer a greeting
_SHOWN = 40  # characters of what another program answers
#: What a client of ZMTP 3.0 with keys sends first: signature, version, mechanism and padding. It receives the same.
_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"CURVE".ljust(52, b"\0")


class Event(Enum):
    """An event of a connection, as ZeroMQ reports it."""

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


def arrives(socket: zmq.Socket[bytes], seconds: float) -> bool:
    """Return True if a socket has a message, or gets one within so many seconds."""
    # To look costs half as much as `poll`, and most sockets that are looked at have no message.
    has_message = int(socket.get(zmq.EVENTS)) & _POLLIN != 0
    return has_message or (seconds > 0 and bool(socket.poll(round(seconds * 1000))))


def greeting(address: str) -> bytes | None:
    """The first bytes of a listener to a client of ZeroMQ with keys, 64 at most; None if it closes the connection.

    It is None, too, if nobody listens. A socket of ZeroMQ sends a greeting of its own, another program something else
    or nothing. libzmq reports a listener with other keys as it does one that closes each connection, such as a tunnel
    whose pipeline has not started.
    """
    parts = urlsplit(address)
    answer = b""
    with ExitStack() as stack:
        try:
            if parts.scheme == "ipc":
                probe = stack.enter_context(sockets.socket(sockets.AF_UNIX))
                probe.connect(address.removeprefix("ipc://"))
            else:
                host = (parts.hostname or "", parts.port or 0)
                probe = stack.enter_context(sockets.create_connection(host, _PROBE_SECONDS))
            probe.settimeout(_PROBE_SECONDS)
            for question in (_GREETING, b"\r\n\r\n"):  # a web server waits for the end of a line
                probe.sendall(question)
                with suppress(TimeoutError):
                    while len(answer) < len(_GREETING) and (part := probe.recv(len(_GREETING) - len(answer))):
                        answer += part
                    return answer or None
                if answer:
                    break
        except OSError:
            return None
    return answer


def has_keys(answer: bytes | None) -> bool:
    """Return True if a greeting is that of a socket of ZeroMQ with keys."""
    return _is_zeromq(answer) and answer[12:32] == _GREETING[12:32]


def other_program(answer: bytes | None) -> str:
    """A description of what listens, by its greeting, if that is no socket of ZeroMQ; empty if it may be one."""
    if answer is None or _is_zeromq(answer):
        return ""
    said = f"sends {answer.decode(errors='replace').splitlines()[0][:_SHOWN]!r}" if answer else "does not answer"
    return f"what listens there {said}"


def silence(address: str) -> str:
    """The reason why a pipeline at an address is silent, as a question."""
    said = other_program(greeting(address))
    return f"{said}: is it a pipeline?" if said else "is a pipeline running there?"


def _is_zeromq(answer: bytes | None) -> TypeGuard[bytes]:
    return answer is not None and answer[:1] == b"\xff" and answer[9:10] == b"\x7f"
