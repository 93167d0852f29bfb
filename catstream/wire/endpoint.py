"""Endpoints: the addresses of the sockets of a pipeline.

An endpoint is a private folder with one Unix socket for each channel (`FOLDER/features`), or a TCP address such as
`tcp://127.0.0.1:5700`, the first port, to which each channel adds its offset. With keys, the host may be reachable from
other machines.
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

_MAX_PATH_BYTES = 107  # the kernel's limit for the path of a Unix socket
_TCP = re.compile(r"tcp://(\*|[A-Za-z0-9_][A-Za-z0-9_.-]{0,252}|\[[^\[\]]+\]):([0-9]{1,5})")
#: An address without its prefix, or another protocol: not a folder, unless a folder of this name exists.
_NO_FOLDER = re.compile(r".*://.*|.*:[0-9]{1,5}/?")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """The address of the sockets of a pipeline: a folder, or a host and the first port; and the keys to connect with.

    host    host in ZeroMQ's syntax
    keys    keys of the connecting side; None if the pipeline has no keys
    source  source of the pipeline's frames, without a password; empty if it is unknown, or for a fleet
    run     id of the run of this process; empty for a client

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
        """The endpoint in the syntax of the setting `run.endpoint`."""
        return str(self.folder) if self.folder is not None else f"tcp://{self.host}:{self.port}"

    @classmethod
    def parse(cls, text: str, keys: str | Keys = "") -> Endpoint:
        """Parse the settings `endpoint` and `keys`; `keys` may be loaded already.

        ServiceError if one of them is invalid, or if other machines can reach the host without keys.
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
                f"other machines can reach {text}, and without keys anyone could connect: make keys "
                "(catstream keys new DIR) and pass them to all (--set run.keys=DIR), or use a folder or "
                "tcp://127.0.0.1:PORT"
            )
        if not (is_host and 1 <= port <= 65535 - last):
            raise ServiceError(f"a tcp endpoint is tcp://HOST:PORT with {last} more ports after PORT, got {text!r}")
        return cls(host=host, port=port, keys=keys)

    def address(self, channel: Channel[object], sender: str | None = None) -> str:
        """The address of a channel in ZeroMQ's syntax; `sender` selects one of several senders."""
        sender = sender or channel.senders[0]
        if self.folder is not None:
            return f"ipc://{self.folder / _file(channel, sender)}"
        return f"tcp://{self.host}:{self.port + channel.port + channel.senders.index(sender)}"

    def listening(self, channel: Channel[object], sender: str | None = None) -> str:
        """The address to listen on, with the host name resolved."""
        address = self.address(channel, sender)
        protocol, _, rest = address.partition("://")
        host, _, port = rest.rpartition(":")
        if protocol == "ipc" or not (numbers := resolved(host)):
            return address  # ZeroMQ reports the error
        number = numbers.get(socket.AF_INET) or f"[{numbers[socket.AF_INET6]}]"
        return f"tcp://{number}:{port}"

    @property
    def is_ipv6(self) -> bool:
        """True if the host has only IPv6 addresses, which ZeroMQ resolves only with the option IPV6."""
        return self.folder is None and [*resolved(self.host)] == [socket.AF_INET6]

    def is_in_use(self, channel: Channel[object], sender: str | None = None) -> bool:
        """Return True if a process listens at a channel's Unix socket, which ZeroMQ would replace silently."""
        if self.folder is None:
            return False
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(self.address(channel, sender).removeprefix("ipc://")) == 0

    def lacks_sockets(self) -> bool:
        """Return True for a folder without sockets: a pipeline removes its sockets at its end."""
        return self.folder is not None and not any(file.exists() for file in socket_files(self.folder))

    def hint(self, what: str = "a pipeline") -> str:
        """A hint for the user if nothing arrives from this endpoint."""
        if self.lacks_sockets():
            if self.folder is not None and not self.folder.exists():
                return f"is {what} running there? There is no folder {self.folder.absolute()}."
            return f"is {what} running there? The folder has no sockets; if it runs, they were removed: restart it."
        return f"is {what} running there{f', with the keys in {self.keys.folder}' if self.keys is not None else ''}?"

    def check_access(self) -> None:
        """Raise ServiceError if this user may not enter the folder."""
        try:
            if self.folder is not None:
                (self.folder / "control").exists()
        except PermissionError:
            raise ServiceError(
                f"permission denied: the folder {str(self.folder)!r} belongs to another user. Attach as the user that "
                "runs the pipeline, or let it listen at tcp://127.0.0.1:PORT (--set run.endpoint=...)"
            ) from None


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def resolved(host: str) -> dict[int, str]:
    """Resolve a host to one address of each address family; empty if the host is unknown."""
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)
    except OSError:
        return {}
    return {int(family): str(address[0]) for family, _, _, _, address in reversed(addresses)}


def _file(channel: Channel[object], sender: str) -> str:
    return channel.name if len(channel.senders) == 1 else f"{channel.name}-{sender}"


def is_too_long(folder: Path) -> bool:
    """Return True if the paths of the Unix sockets in a folder exceed the kernel's limit."""
    return any(len(os.fsencode(file)) > _MAX_PATH_BYTES for file in socket_files(folder))


def socket_files(folder: Path) -> Iterator[Path]:
    """Paths of the sockets of all channels in a folder, including the registry."""
    return (folder / _file(channel, sender) for channel in (*CHANNELS.values(), REGISTRY) for sender in channel.senders)
