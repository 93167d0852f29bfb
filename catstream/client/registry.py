"""The client of the registry of a fleet, which lists its streams and the node of each.

The controller of the fleet serves the registry. A client on another machine needs keys with the role "watch". It
receives the endpoint and the public key of a stream's pipeline, and connects with its own keys. No secret is
transmitted.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from uuid import uuid4

import msgspec

from catstream.errors import ServiceError, SilenceError
from catstream.wire.channels import REGISTRY
from catstream.wire.commands import ANSWER_SECONDS, Requester
from catstream.wire.discovery import fleets
from catstream.wire.endpoint import Endpoint, resolved
from catstream.wire.keys import Keys
from catstream.wire.messages import FleetStatus, Listing, Question, StreamStatus

#: Default port of the registry of a cluster.
REGISTRY_PORT = 5690


class Registry(AbstractContextManager["Registry"]):
    """Queries the controller of a fleet for streams and nodes; SilenceError if no answer arrives before the timeout.

    `fleet` is HOST:PORT, the name of a fleet of this user on this machine, or empty for the only one; `keys` is the
    folder of the keys of this client, if the fleet requires keys.
    """

    def __init__(self, fleet: str = "", keys: str = "", *, timeout: float = ANSWER_SECONDS) -> None:
        self.timeout = timeout
        own = Keys.load(keys) if keys else None
        fleet = fleet.removeprefix("fleet://").removeprefix("tcp://").rstrip("/")
        self._name, self._endpoint = _remote(fleet, own) if ":" in fleet else _local(fleet, own)
        self._requester = Requester[Question, Listing](REGISTRY, self._endpoint)
        self._question = ""  # id of the last query of `request`

    def streams(self, only: str = "") -> FleetStatus:
        """The state of all streams and nodes, or of one stream."""
        answer = self._requester.ask(Question(uuid4().hex, only), self.timeout)
        if answer is None:
            raise SilenceError(
                f"no answer from the fleet {self._name} at {self._endpoint} within {self.timeout:g} s: "
                f"{self._endpoint.hint('its controller')}"
            )
        return _status(answer)

    def stream(self, stream: str) -> StreamStatus:
        """The state of one stream; ServiceError if the fleet has no such stream."""
        status = self.streams(stream)
        if stream not in status.streams:
            names = ", ".join(self.streams().streams) or "none"
            raise ServiceError(f"the fleet {status.name} has no stream {stream!r}: its streams are {names}")
        return status.streams[stream]

    def running(self, stream: str) -> Endpoint:
        """The endpoint of the pipeline of a stream; ServiceError if it is not running."""
        status = self.stream(stream)
        if not status.endpoint:
            raise ServiceError(f"stream {stream} is not running (state: {described(status)})")
        return self.endpoint_of(status)

    def endpoint_of(self, status: StreamStatus) -> Endpoint:
        """The endpoint of the pipeline of a running stream, with the keys to connect."""
        keys = self._endpoint.keys
        if status.server and keys is None:
            raise ServiceError(
                f"the stream {status.name} requires authentication: pass a folder of keys that its fleet allows "
                "(--keys DIR, see catstream keys)"
            )
        of_stream = replace(keys, server=status.server.encode()) if status.server and keys is not None else ""
        return replace(Endpoint.parse(status.endpoint, of_stream), source=status.source)

    def request(self, stream: str) -> None:
        """Query one stream without waiting; `receive` returns the answer. A new request replaces the last one."""
        self._question = uuid4().hex
        self._requester.send(Question(self._question, stream))

    def receive(self) -> FleetStatus | None:
        """The answer to `request` if it has arrived."""
        answer = self._requester.receive(self._question, 0)
        return None if answer is None else _status(answer)

    def close(self) -> None:
        self._requester.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _remote(fleet: str, keys: Keys | None) -> tuple[str, Endpoint]:
    """Address and endpoint of a registry."""
    host, _, _ = fleet.rpartition(":")
    if not resolved(host):
        raise ServiceError(f"the host {host!r} of the fleet is unknown: check its address")
    if keys is None and not fleet.startswith(("127.", "[::1]:", "localhost:")):
        raise ServiceError(
            f"the fleet at {fleet} requires authentication: make keys on its head node (catstream keys allow "
            "FOLDER/keys NAME --output DIR), and pass them (--keys DIR)"
        )
    return fleet, Endpoint.parse(f"tcp://{fleet}", keys or "")


def _local(fleet: str, keys: Keys | None) -> tuple[str, Endpoint]:
    """Name and endpoint of a fleet of this user."""
    registries = fleets()
    names = ", ".join(sorted(registries))
    if not fleet and len(registries) > 1:
        raise ServiceError(
            f"{len(registries)} fleets are running: select one (--fleet NAME, or fleet://NAME/STREAM): {names}"
        )
    fleet = fleet or names
    if fleet not in registries:
        name, others = f"{fleet!r} " if fleet else "", f", only {names}" if names else ""
        raise ServiceError(
            f"no fleet {name}of yours is running{others}: start it (catstream fleet up), or pass the registry HOST:PORT"
        )
    return fleet, registries[fleet] if keys is None else replace(registries[fleet], keys=keys)


def _status(answer: Listing) -> FleetStatus:
    try:
        return msgspec.json.decode(answer.fleet, type=FleetStatus)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ServiceError(f"invalid answer of the registry ({error}): use the same version of catstream") from None


def described(status: StreamStatus) -> str:
    """Describe the state and the trouble of a stream."""
    return ", ".join(filter(None, (status.state, status.trouble)))
