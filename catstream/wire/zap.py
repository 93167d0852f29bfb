"""Authentication of the peers that connect to the sockets of this process (ZAP, RFC 27)."""

from __future__ import annotations

import itertools
import threading

import zmq
from zmq.utils import z85

from catstream.errors import ServiceError
from catstream.wire.channels import Channel
from catstream.wire.keys import ROLES, Keys, clients
from catstream.wire.rejects import reject


class ZapHandler:
    """Authorises peers at the listening sockets of this process, if the pipeline has keys.

    libzmq sends one request for each connection (ZAP, RFC 27) before it reads a message. It contains the socket's
    "domain", and the public key of the peer, which has already proved that it has the secret key.
    A thread answers while a socket is registered. See decision 23 in docs/decisions.md.
    """

    _address = "inproc://zeromq.zap.01"

    def __init__(self) -> None:
        self._sockets: dict[bytes, tuple[Channel[object], Keys]] = {}  # by domain
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def register(self, context: zmq.Context[zmq.Socket[bytes]], channel: Channel[object], keys: Keys) -> bytes:
        """Register a listening socket; returns its domain."""
        with self._lock:
            domain = f"{channel.name} {next(self._numbers)}".encode()
            self._sockets[domain] = channel, keys
            if self._thread is None:
                self._context = context
                socket = context.socket(zmq.REP)
                socket.bind(self._address)
                self._thread = threading.Thread(target=self._serve, args=(socket,), name="zap", daemon=True)
                self._thread.start()
        return domain

    def unregister(self, domain: bytes) -> None:
        with self._lock:
            self._sockets.pop(domain, None)
            if self._thread is not None and not self._sockets:
                with self._context.socket(zmq.REQ) as last:
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
            socket.unbind(self._address)  # closing is asynchronous, and the next thread needs the address

    def _status(self, domain: bytes, address: str, mechanism: bytes, credentials: list[bytes]) -> bytes:
        """The ZAP status of a peer: allowed (200), temporary error (300), or denied (400)."""
        if domain not in self._sockets or mechanism != b"CURVE":
            return b"400"
        channel, keys = self._sockets[domain]
        public = z85.encode(credentials[0]).decode()
        try:
            allowed = [(name, client.role) for name, client in clients(keys.folder).items() if client.public == public]
        except ServiceError as error:
            reject(channel.name, str(error), f"clients cannot connect: {error}")
            return b"300"
        reason = f"its key {public} is not allowed"
        for name, role in allowed:
            if ROLES.index(role) >= ROLES.index(channel.role):
                return b"200"
            reason = f"the role of {name} is {role} and not {channel.role}"
        reject(channel.name, public, f"{address} was rejected: {reason}")
        return b"400"
