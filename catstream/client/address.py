"""Addresses of running pipelines and of streams of fleets, parsed once where they enter the program.

run                        the pipeline at this endpoint: a folder, or tcp://HOST:PORT
                           (empty) the only running pipeline of this user
fleet://cam-7              a stream of the only fleet of this user on this machine
fleet://site/cam-7         a stream of the fleet with this name
fleet://head:5690/cam-7    a stream of the fleet whose registry listens there
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from catstream.client.registry import Registry
from catstream.errors import ServiceError
from catstream.wire.discovery import find
from catstream.wire.endpoint import Endpoint

_SCHEME = "fleet://"


@dataclass(frozen=True, slots=True)
class Address:
    """The address of a running pipeline or of a stream of a fleet, and the keys of the client.

    endpoint  of the pipeline; empty for the only running pipeline
    stream    name of the stream; empty for a pipeline
    fleet     of the stream: HOST:PORT of its registry, or its name; empty for the only one of this user
    keys      folder of the keys of this client; empty if there are none

    >>> Address.parse("fleet://head:5690/cam-7")
    Address(endpoint='', stream='cam-7', fleet='head:5690', keys='')
    >>> str(Address(stream="cam-7", fleet="site")), str(Address.parse("run"))
    ('fleet://site/cam-7', 'run')
    """

    endpoint: str = ""
    stream: str = ""
    fleet: str = ""
    keys: str = ""

    def __str__(self) -> str:
        if not self.stream:
            return self.endpoint
        return f"{_SCHEME}{self.fleet}/{self.stream}" if self.fleet else f"{_SCHEME}{self.stream}"

    @classmethod
    def parse(cls, text: str | os.PathLike[str] | Address, keys: str = "") -> Address:
        """Parse an endpoint or the address of a stream; ServiceError if it is neither."""
        if isinstance(text, Address):
            return text
        text = os.fspath(text)
        if not text.startswith(_SCHEME):
            return cls(text, keys=keys)
        fleet, _, stream = text.removeprefix(_SCHEME).rpartition("/")
        if not stream or "/" in fleet or (":" in stream and not fleet):
            raise ServiceError(
                "the address of a stream is fleet://STREAM, fleet://FLEET/STREAM or fleet://HOST:PORT/STREAM, got "
                f"{text!r}"
            )
        return cls(stream=stream, fleet=fleet, keys=keys)

    @property
    def registry(self) -> Registry:
        """A new connection to the registry of the fleet, which the caller closes."""
        return Registry(self.fleet, self.keys)

    def with_endpoint(self) -> Address:
        """The same address; if it is empty, the endpoint of the only running pipeline, even if others start later."""
        if self.stream or self.endpoint:
            return self
        endpoint = self.resolve()
        return Address(str(endpoint), keys=str(endpoint.keys.folder) if endpoint.keys is not None else "")

    def resolve(self) -> Endpoint:
        """The endpoint of the pipeline, or of the current pipeline of the stream.

        ServiceError if there is no such pipeline or stream, or the stream is not running; SilenceError if the registry
        does not answer. With an explicit endpoint, the pipeline may start later.
        """
        if self.stream:
            with self.registry as registry:
                return registry.running(self.stream)
        if not self.endpoint:
            return find()
        endpoint = Endpoint.parse(self.endpoint, self.keys)
        endpoint.check_access()
        return endpoint
