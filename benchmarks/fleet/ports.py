"""The ports that the processes of a local fleet listen on, from /proc."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from catstream.fleet.keeper import holder
from catstream.fleet.local import LocalFleet

_LISTENING = "0A"  # state of a socket in /proc/net/tcp


@dataclass(frozen=True, slots=True)
class Port:
    """A port of a process: address it listens at ("0.0.0.0" for all interfaces), number, name of the process."""

    address: str
    number: int
    process: str


def listening(fleet: LocalFleet, node: str) -> list[Port]:
    """The ports of a node's processes."""
    keeper = holder(node, fleet.folder)
    return sorted(_ports(keeper), key=lambda port: port.number) if keeper is not None else []


def _ports(root: int) -> Iterator[Port]:
    sockets = _sockets(root)
    for pid in _tree(root):
        with suppress(OSError):
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            for link in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):
                    if (found := sockets.get(link.readlink().name)) is not None:
                        yield Port(*found, name)


def _sockets(pid: int) -> dict[str, tuple[str, int]]:
    """Address and port of each listening socket in the network namespace of a process, by `socket:[INODE]`."""
    found = {}
    for version in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{version}").read_text().splitlines()[1:]:
            words = line.split()
            host, port = words[1].split(":")
            if words[3] == _LISTENING:
                found[f"socket:[{words[9]}]"] = _address(host), int(port, 16)
    return found


def _address(text: str) -> str:
    """An address as /proc/net/tcp has it: 32-bit words, each in the order of this machine."""
    data = b"".join(bytes.fromhex(text[i : i + 8])[::-1] for i in range(0, len(text), 8))
    address = ipaddress.ip_address(data)
    if isinstance(address, ipaddress.IPv6Address):
        return str(address.ipv4_mapped or ("0.0.0.0" if not int(address) else address))
    return str(address)


def _tree(pid: int) -> Iterator[int]:
    yield pid
    with suppress(OSError):  # it has ended
        for thread in Path(f"/proc/{pid}/task").iterdir():
            for child in map(int, (thread / "children").read_text().split()):
                yield from _tree(child)
