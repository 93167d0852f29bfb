"""Decides which peers may connect to the sockets of this process that listen, if the pipeline has keys.

libzmq asks once for each connection, before it reads a message of it, by its protocol ZAP (RFC 27). A question names
the socket, as a "domain", and the peer's public key; the peer has proved by then that it holds the secret one. The
list of clients is read for each question, so no process has to be restarted if a client is allowed or revoked. A
connection that is open stays open.

pyzmq's own handler, `zmq.auth`, is not used: see docs/decisions/0023-roles.md.
"""

from __future__ import annotations

import itertools
import threading

import zmq
from zmq.utils import z85

from catstream.errors import ServiceError
from catstream.wire.channels import Channel
from catstream.wire.context import context
from catstream.wire.keys import ROLES, Keys
from catstream.wire.rejects import reject

_ADDRESS = "inproc://zeromq.zap.01"
_VERSION = b"1.0"
_ALLOWED, _TRY_LATER, _DENIED = b"200", b"300", b"400"


class ZapHandler:
    """Answers libzmq's questions for all sockets of a process; its thread runs while a socket is registered."""

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
                socket.bind(_ADDRESS)
                self._thread = threading.Thread(target=self._serve, args=(socket,), name="zap", daemon=True)
                self._thread.start()
        return domain

    def unregister(self, domain: bytes) -> None:
        """Unregister a closed socket."""
        with self._lock:
            self._sockets.pop(domain, None)
            if self._thread is not None and not self._sockets:
                with context().socket(zmq.REQ) as last:
                    last.connect(_ADDRESS)
                    last.send(b"")
                    self._thread.join()
                self._thread = None

    def _serve(self, socket: zmq.Socket[bytes]) -> None:
        with socket:
            while len(question := socket.recv_multipart()) > 1:
                _, request, domain, address, _, mechanism, *credentials = question
                status, name = self._decide(domain, address.decode(errors="replace"), mechanism, credentials)
                socket.send_multipart([_VERSION, request, status, b"", name, b""])
            socket.unbind(_ADDRESS)  # at once: libzmq closes some time later, and the next thread needs the address

    def _decide(self, domain: bytes, address: str, mechanism: bytes, credentials: list[bytes]) -> tuple[bytes, bytes]:
        """The status that lets a peer connect or not, and the peer's name."""
        if domain not in self._sockets or mechanism != b"CURVE":
            return _DENIED, b""
        channel, keys = self._sockets[domain]
        public = z85.encode(credentials[0]).decode()
        try:
            client = keys.client(public)
        except ServiceError as error:
            reject(channel.name, "unreadable", f"nobody can connect: {error}", once=str(error))
            return _TRY_LATER, b""
        if client is None:
            reject(channel.name, "key", f"{address} was rejected, its key {public} is not allowed", once=public)
            return _DENIED, b""
        name, role = client
        if ROLES.index(role) < ROLES.index(channel.role):
            text = f"{name} at {address} was rejected, its role is {role} and not {channel.role}"
            reject(channel.name, "role", text, once=public)
            return _DENIED, b""
        return _ALLOWED, name.encode()


#: The handler of this process: libzmq asks one for each context.
ZAP = ZapHandler()
