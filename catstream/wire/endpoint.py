"""Endpoints: the addresses of the sockets of a pipeline.

An endpoint is a folder with one Unix socket for each channel (`FOLDER/features`), which only this user may enter; or
`tcp://127.0.0.1:5700`, from which each channel takes the port that its row in the table says. With keys other machines
may reach the host.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from catstream.errors import ServiceError
from catstream.wire.channels import CHANNELS, REGISTRY, Channel
from catstream.wire.keys import Keys

_MAX_PATH_BYTES = 107  # of the name of a Unix socket, as the kernel limits it
_TCP = re.compile(r"tcp://(\*|[A-Za-z0-9_][A-Za-z0-9_.-]{0,252}|\[[^\[\]]+\]):([0-9]{1,5})")
#: An address without its prefix, or another protocol: no folder, unless there is one of this name.
_NO_FOLDER = re.compile(r".*://.*|.*:[0-9]{1,5}/?")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """The address of the sockets of a pipeline: a folder, or a host and the first port; and the keys to connect with.

    host    as ZeroMQ takes it
    keys    to connect with; None if the pipeline has no keys
    source  of the pipeline's frames, without a password; empty if it is not known here, or for a fleet
    run     id of the run whose process this is; empty for a client

    >>> Endpoint.parse("tcp://localhost:5700").address(CHANNELS["models"])
    'tcp://127.0.0.1:5702'
    >>> Endpoint.parse("run").address(CHANNELS["health"], "trainer")
    'ipc://run/health-trainer'
    """

    folder: Path | None = None
    host: str = ""
    port: int = 0
    keys: Keys | None = None
    source: str = field(default="", compare=False)
    run: str = field(default="", compare=False)

    def __str__(self) -> str:
        """As the setting `run.endpoint` says it."""
        return str(self.folder) if self.folder is not None else f"tcp://{self.host}:{self.port}"

    @classmethod
    def parse(cls, text: str, keys: str | Keys = "") -> Endpoint:
        """Read the settings `endpoint` and `keys`; the keys may have been loaded already.

        ServiceError if one of them is not valid, or if other machines can reach the host and there are no keys.
        """
        if not text:
            raise ServiceError("this process needs the endpoint of its pipeline: --set run.endpoint=FOLDER")
        loaded = keys if isinstance(keys, Keys) else Keys.load(keys) if keys else None
        if text.startswith("tcp://"):
            return cls._tcp(text, loaded)
        folder = Path(text)
        if _NO_FOLDER.fullmatch(text) and not folder.exists():
            raise ServiceError(f"an endpoint is a folder or tcp://HOST:PORT, got {text!r}")
        if folder.exists() and not folder.is_dir():
            raise ServiceError(f"an endpoint is a folder, and {text!r} is a file: pass a folder")
        if is_too_long(folder):
            raise ServiceError(
                f"the name of the folder {text!r} is too long for a Unix socket: use a shorter one "
                "(--set run.endpoint=FOLDER), or set TMPDIR to a shorter folder for temporary files"
            )
        return cls(folder=folder, keys=loaded)

    @classmethod
    def _tcp(cls, text: str, keys: Keys | None) -> Endpoint:
        last = max(channel.port + len(channel.senders) for channel in CHANNELS.values()) - 1
        parts = _TCP.fullmatch(text)
        host, port = (parts[1], int(parts[2])) if parts is not None else ("", 0)
        host = {"localhost": "127.0.0.1", "*": "0.0.0.0"}.get(host, host)
        address = _address(host)
        is_host = bool(host) and (address is not None or not host.startswith("["))
        if keys is None and is_host and (address is None or not address.is_loopback):
            raise ServiceError(
                f"other machines can reach {text}, and without keys anybody could connect: make keys "
                "(catstream keys new DIR) and pass them to all (--set run.keys=DIR), or use a folder or "
                "tcp://127.0.0.1:PORT"
            )
        if not (is_host and 1 <= port <= 65535 - last):
            raise ServiceError(f"a tcp endpoint is tcp://HOST:PORT with {last} more ports after PORT, got {text!r}")
        return cls(host=host, port=port, keys=keys)

    def address(self, channel: Channel[object], sender: str | None = None) -> str:
        """The address of a channel, as ZeroMQ takes it; of the given sender if there are several."""
        sender = sender or channel.senders[0]
        if self.folder is not None:
            return f"ipc://{self.folder / _file(channel, sender)}"
        return f"tcp://{self.host}:{self.port + channel.port + channel.senders.index(sender)}"

    def listening(self, channel: Channel[object], sender: str | None = None) -> str:
        """The address to listen on; the name of a host is resolved."""
        address = self.address(channel, sender)
        protocol, _, rest = address.partition("://")
        host, _, port = rest.rpartition(":")
        if protocol == "ipc" or not (numbers := resolved(host)):
            return address  # ZeroMQ reports the error
        number = numbers.get(socket.AF_INET) or f"[{numbers[socket.AF_INET6]}]"
        return f"tcp://{number}:{port}"

    @property
    def is_ipv6(self) -> bool:
        """True if the host has addresses of IPv6 only; ZeroMQ would not look for them."""
        return self.folder is None and [*resolved(self.host)] == [socket.AF_INET6]

    def is_in_use(self, channel: Channel[object], sender: str | None = None) -> bool:
        """Return True if a process listens at a channel's Unix socket; ZeroMQ would replace it without an error."""
        if self.folder is None:
            return False
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(self.address(channel, sender).removeprefix("ipc://")) == 0

    def lacks_sockets(self) -> bool:
        """Return True if it is a folder without any socket: a pipeline removes all of its own at its end."""
        return self.folder is not None and not any(file.exists() for file in socket_files(self.folder))

    def hint(self, what: str = "a pipeline") -> str:
        """What to check if nothing arrives from this endpoint."""
        if self.lacks_sockets():
            if self.folder is not None and not self.folder.exists():
                return f"is {what} running there? There is no folder {self.folder.absolute()}."
            return f"is {what} running there? It has no sockets: if it runs, they were removed; start it again."
        return f"is {what} running there{f', with the keys in {self.keys.folder}' if self.keys is not None else ''}?"

    def check_access(self) -> None:
        """Raise ServiceError if it is a folder that this user may not enter."""
        try:
            if self.folder is not None:
                (self.folder / "control").exists()
        except PermissionError:
            raise ServiceError(
                f"the folder {str(self.folder)!r} is of another user, and this one may not enter it: attach as the "
                "user that runs the pipeline, or let it listen at tcp://127.0.0.1:PORT (--set run.endpoint=...)"
            ) from None


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def resolved(host: str) -> dict[int, str]:
    """One address of a host for each address family; empty if the host is unknown."""
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)
    except OSError:
        return {}
    return {int(family): str(address[0]) for family, _, _, _, address in reversed(addresses)}


def _file(channel: Channel[object], sender: str) -> str:
    return channel.name if len(channel.senders) == 1 else f"{channel.name}-{sender}"


def is_too_long(folder: Path) -> bool:
    """Return True if the kernel does not take the names of Unix sockets in a folder."""
    return any(len(os.fsencode(file)) > _MAX_PATH_BYTES for file in socket_files(folder))


def socket_files(folder: Path) -> Iterator[Path]:
    """The socket of each channel in a folder, and of the registry."""
    return (folder / _file(channel, sender) for channel in (*CHANNELS.values(), REGISTRY) for sender in channel.senders)
