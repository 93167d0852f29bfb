"""The gate: who may connect to the sockets of this process that listen, where the pipeline has keys.

ZeroMQ asks for each connection, by its protocol ZAP (RFC 27), before a message of it is read: which
socket, and which public key the peer has proved to hold. The answer is looked up anew each time,
so who is allowed or revoked needs no restart. A connection that is made stays until it ends.
"""

from __future__ import annotations

import itertools
import threading
from typing import Any

import zmq
from zmq.utils import z85

from catstream.errors import ServiceError
from catstream.wire.channels import Channel
from catstream.wire.keys import ROLES, Keys
from catstream.wire.refusals import refuse

__all__ = ["GATE"]

_ADDRESS = "inproc://zeromq.zap.01"
_VERSION = b"1.0"
_ALLOWED, _LATER, _DENIED = b"200", b"300", b"400"


class _Gate:
    """Answers for all sockets of a process, in a thread of its own while there is one."""

    def __init__(self) -> None:
        self._guarded: dict[bytes, tuple[Channel, Keys]] = {}  # by domain, as ZAP calls the name of a socket
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def guard(self, channel: Channel, keys: Keys) -> bytes:
        """Answer for one more socket; returns its domain."""
        with self._lock:
            domain = f"{channel.name} {next(self._numbers)}".encode()
            self._guarded[domain] = channel, keys
            if self._thread is None:
                socket = _socket(zmq.REP)
                socket.bind(_ADDRESS)
                self._thread = threading.Thread(target=self._serve, args=(socket,), name="gate", daemon=True)
                self._thread.start()
        return domain

    def leave(self, domain: bytes) -> None:
        """Answer for a socket no more: it is closed."""
        with self._lock:
            self._guarded.pop(domain, None)
            if self._thread is not None and not self._guarded:
                with _socket(zmq.REQ) as last:
                    last.connect(_ADDRESS)
                    last.send(b"")
                    self._thread.join()
                self._thread = None

    def _serve(self, socket: Any) -> None:
        with socket:
            while len(question := socket.recv_multipart()) > 1:
                _, request, domain, address, _, mechanism, *credentials = question
                status, name = self._answer(domain, address.decode(errors="replace"), mechanism, credentials)
                socket.send_multipart([_VERSION, request, status, b"", name, b""])
            socket.unbind(_ADDRESS)  # at once, for the next one: ZeroMQ closes some time later

    def _answer(self, domain: bytes, address: str, mechanism: bytes, credentials: list[bytes]) -> tuple[bytes, bytes]:
        """Whether a peer may come in, and its name."""
        if domain not in self._guarded or mechanism != b"CURVE":
            return _DENIED, b""
        channel, keys = self._guarded[domain]
        public = z85.encode(credentials[0]).decode()
        try:
            client = keys.client(public)
        except ServiceError as error:
            refuse(channel.name, "unreadable", f"nobody can connect: {error}", once=str(error))
            return _LATER, b""
        if client is None:
            refuse(channel.name, "key", f"{address} was turned away, its key {public} is not allowed", once=public)
            return _DENIED, b""
        name, role = client
        if ROLES.index(role) < ROLES.index(channel.role):
            text = f"{name} at {address} was turned away, its role is {role} and not {channel.role}"
            refuse(channel.name, "role", text, once=public)
            return _DENIED, b""
        return _ALLOWED, name.encode()


def _socket(kind: int) -> Any:
    context: Any = zmq.Context.instance()  # its types do not know a socket's options
    return context.socket(kind)


GATE = _Gate()
