"""Endpoints: the addresses of the sockets of a pipeline, and the search for running pipelines.

An endpoint is a folder with one Unix socket for each channel (`FOLDER/features`), which only this user may enter; or
`tcp://127.0.0.1:5700`, from which each channel takes the port that its row in the table says. With keys other machines
may reach the host.
"""

from __future__ import annotations

import contextlib
import ipaddress
import math
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from catstream.base.addresses import without_password
from catstream.base.files import descriptor, is_locked, lock, writing
from catstream.errors import ServiceError
from catstream.wire.channels import CHANNELS, REGISTRY, Channel
from catstream.wire.keys import Keys

_MAX_PATH_BYTES = 107  # of the name of a Unix socket, as the kernel limits it
_PREFIX = "catstream-"  # of private folders
_TCP = re.compile(r"tcp://(\*|[A-Za-z0-9_][A-Za-z0-9_.-]{0,252}|\[[^\[\]]+\]):([0-9]{1,5})")
#: HOST:PORT, perhaps with a part of the prefix, which is no folder unless there is one.
_NO_FOLDER = re.compile(r"(?:tcp:/*|//)?(?P<host>[A-Za-z0-9_.*-]*|\[[^\[\]/]+\]):(?P<port>[0-9]{1,5})/?")
_OWNER = "owner"  # file in a private folder, locked while its owner lives
_NOTE = "endpoint"  # note in the private folder of a running pipeline: its endpoint, folder of keys, and source
_FLEET_NOTE = "fleet-endpoint"  # note in that of the controller of a fleet: its endpoint, folder of keys, and name
_ANY_BYTES = "surrogateescape"  # in notes: the name of a file need not be UTF-8


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
        known = keys if isinstance(keys, Keys) else Keys.load(keys) if keys else None
        if text.startswith("tcp://"):
            return cls._tcp(text, known)
        folder = Path(text)
        if (meant := _NO_FOLDER.fullmatch(text)) is not None and not folder.exists():
            address = f"tcp://{meant['host'] or '127.0.0.1'}:{meant['port']}"
            raise ServiceError(f"an endpoint is a folder or tcp://HOST:PORT (got {text!r}): did you mean {address}?")
        if "://" in text:
            raise ServiceError(f"an endpoint is a folder or tcp://HOST:PORT (got {text!r})")
        if folder.exists() and not folder.is_dir():
            raise ServiceError(f"an endpoint is a folder, and {text!r} is a file: pass a folder")
        if _is_too_long(folder):
            raise ServiceError(
                f"the name of the folder {text!r} is too long for a Unix socket: give a shorter one "
                "(--set run.endpoint=FOLDER), or set TMPDIR to a shorter folder for temporary files"
            )
        return cls(folder=folder, keys=known)

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
                "(catstream keys new DIR) and give them to all (--set run.keys=DIR), or give a folder or "
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
        protocol, _, place = address.partition("://")
        host, _, port = place.rpartition(":")
        if protocol == "ipc" or not (known := _resolved(host)):
            return address  # ZeroMQ reports what is wrong with it
        number = known.get(socket.AF_INET) or f"[{known[socket.AF_INET6]}]"
        return f"tcp://{number}:{port}"

    @property
    def is_ipv6(self) -> bool:
        """Whether the host has addresses of IPv6 only; ZeroMQ would not look for them."""
        return self.folder is None and [*_resolved(self.host)] == [socket.AF_INET6]

    def taken(self, channel: Channel[object], sender: str | None = None) -> bool:
        """Whether a process listens at a channel's Unix socket; ZeroMQ would replace it without an error."""
        if self.folder is None:
            return False
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(self.address(channel, sender).removeprefix("ipc://")) == 0

    def lacks_sockets(self) -> bool:
        """Whether it is a folder without any socket: a pipeline removes all of its own at its end."""
        return self.folder is not None and not any(file.exists() for file in _files(self.folder))

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


#: The endpoint of a pipeline, as a program gives it.
Place = str | os.PathLike[str] | Endpoint


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def _resolved(host: str) -> dict[int, str]:
    """An address of a host of each family that it has; empty if it is not known."""
    try:
        found = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)
    except OSError:
        return {}
    return {int(family): str(place[0]) for family, _, _, _, place in reversed(found)}


def _file(channel: Channel[object], sender: str) -> str:
    return channel.name if len(channel.senders) == 1 else f"{channel.name}-{sender}"


def _is_too_long(folder: Path) -> bool:
    """Whether the kernel does not take the names of Unix sockets in a folder."""
    return any(len(os.fsencode(file)) > _MAX_PATH_BYTES for file in _files(folder))


def _files(folder: Path) -> Iterator[Path]:
    """The socket of each channel in a folder, that of the registry too."""
    return (folder / _file(channel, each) for channel in (*CHANNELS.values(), REGISTRY) for each in channel.senders)


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder that only this user may enter, removed afterwards; also removes those of killed processes.

    It is locked, as programs that remove old temporary files leave a locked folder alone (systemd-tmpfiles).
    """
    if not (homes := _homes()):
        raise ServiceError("no folder for temporary files can be written to: set TMPDIR to one")
    home = next((each for each in homes if not _is_too_long(each / f"{_PREFIX}12345678")), homes[0])
    for path, text in _notes([home], f"{_PREFIX}*/{_OWNER}"):
        if text is None:
            shutil.rmtree(path.parent, ignore_errors=True)
    with contextlib.ExitStack() as stack:
        with writing(home):
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=home))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            lock(stack.enter_context(descriptor(folder, os.O_DIRECTORY)))
            stack.enter_context(note(folder / _OWNER, ""))
        owner = os.getpid()
        try:
            yield folder
        finally:
            if owner != os.getpid():  # a copy of this process that was forked
                stack.pop_all()


@contextlib.contextmanager
def reserve_endpoint(text: str, default: Path, keys: str = "", source: str = "", fleet: str = "") -> Iterator[Endpoint]:
    """The endpoint of one pipeline, or of the registry of a fleet, locked for it; removes all socket files afterwards.

    `text` and `keys` are settings. The private folder `default` is used if `text` is empty, and the endpoint is found
    by a note in it, with the source of the frames, without a password, or the name of the fleet.
    """
    endpoint = Endpoint.parse(text or str(default), keys)
    if endpoint.keys is not None:  # else its own processes would wait until the file of a client is mended
        endpoint.keys.listening()
        endpoint.keys.client(endpoint.keys.public.decode())
    with contextlib.ExitStack() as stack:
        if text and endpoint.folder is not None:  # of tcp, the kernel gives a port to one process only
            folder = stack.enter_context(_locked(endpoint.folder.absolute(), text))
            endpoint = Endpoint.parse(str(folder), endpoint.keys or "")
        place = str(endpoint), str(endpoint.keys.folder) if endpoint.keys is not None else "", fleet or source
        with writing(default):
            stack.enter_context(note(default / (_FLEET_NOTE if fleet else _NOTE), "\n".join(place)))
        yield endpoint


@contextlib.contextmanager
def _locked(folder: Path, text: str) -> Iterator[Path]:
    """A folder for the sockets of one pipeline, which is made; the sockets are removed afterwards."""
    with contextlib.ExitStack() as stack:
        with writing(folder):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = stack.enter_context(descriptor(folder, os.O_DIRECTORY))
        facts = os.fstat(handle)
        if facts.st_uid != os.geteuid() or facts.st_mode & 0o022:
            raise ServiceError(f"other users may write to {text!r}: give a folder of your own, chmod 700")
        if not lock(handle):
            raise ServiceError(
                f"a pipeline is already running on {text!r}: "
                "wait for it, or give another folder (--set run.endpoint=FOLDER)"
            )
        owner = os.getpid()
        try:
            yield folder
        finally:
            if owner == os.getpid():  # not a copy of this process that was forked
                for file in _files(folder):
                    file.unlink(missing_ok=True)


def running() -> list[Endpoint]:
    """Endpoints of this user's running pipelines, in no order."""
    return [replace(endpoint, source=source) for endpoint, source in _endpoints(_NOTE)]


def fleets() -> dict[str, Endpoint]:
    """Endpoints of the controllers of this user's running fleets on this machine, by the names of the fleets."""
    return {name: endpoint for endpoint, name in _endpoints(_FLEET_NOTE)}


def _endpoints(note: str, *, strict: bool = False) -> Iterator[tuple[Endpoint, str]]:
    """The endpoint in each note whose process is running, and the source or name in it.

    One whose keys cannot be read must not hide the others: it is skipped, or an error if `strict`.
    """
    for _, text in _notes(_homes(), f"{_PREFIX}*/{note}"):
        if text:
            place, keys, about = [*text.split("\n", 2), "", ""][:3]  # another version may write less
            try:
                yield Endpoint.parse(place, keys), about
            except ServiceError:
                if strict:
                    raise


def find(text: Place = "", keys: str = "", source: str = "") -> Endpoint:
    """The endpoint of a running pipeline: the given one, the one with this source, or the user's only one.

    The keys of this user's pipelines are known. The source is as it was given to the pipeline, or its file name; that
    of a given endpoint is not looked for: see `source_at`. ServiceError if there is none, or more than one, or if
    it is a folder of another user.
    """
    if isinstance(text, Endpoint):
        return text
    if text:
        given = Endpoint.parse(os.fspath(text), keys)
        given.check_access()
        return given
    endpoints = running()
    if not endpoints:
        list(_endpoints(_NOTE, strict=True))  # one whose keys cannot be read is running: say so
        raise ServiceError("no pipeline of yours is running: start one (catstream track), or give its --endpoint")
    source = without_password(source)  # as it is in the note
    found = [endpoint for endpoint in endpoints if not source or _follows(endpoint, source)]
    if len(found) == 1:
        return found[0]
    if not found:
        raise ServiceError(f"no pipeline of yours tracks {source!r}: give one of these{_listed(endpoints)}")
    what = f"track {source!r}" if source else "are running"
    raise ServiceError(f"{len(found)} pipelines {what}: say which (--endpoint){_listed(found)}")


def _listed(endpoints: list[Endpoint]) -> str:
    """List the running pipelines, for the end of an error message."""
    return "".join(f"; {place.source or 'a pipeline'} at {place}" for place in sorted(endpoints, key=str))


def source_at(endpoint: Endpoint) -> str:
    """The source of the pipeline at an endpoint, if that is one of this user; empty if it is not known."""
    if endpoint.source:
        return endpoint.source
    place = str(endpoint.folder.absolute()) if endpoint.folder is not None else str(endpoint)
    return next((other.source for other in running() if str(other) == place), "")


def _follows(endpoint: Endpoint, source: str) -> bool:
    """Whether a pipeline has this source: the same text, the same file, or a file of that name."""
    return endpoint.source in (source, str(Path(source).absolute())) or Path(endpoint.source).name == source


@contextlib.contextmanager
def note(path: Path, text: str) -> Iterator[None]:
    """A file that is locked as long as its process uses it; it is never visible without its lock and text."""
    hidden, owner = path.with_name(f".{path.name}"), os.getpid()
    with descriptor(hidden, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as handle:
        try:
            lock(handle, math.inf)
            os.write(handle, text.encode(errors=_ANY_BYTES))
            hidden.rename(path)
            yield
        finally:
            if owner == os.getpid():  # not a copy of this process that was forked
                hidden.unlink(missing_ok=True)
                path.unlink(missing_ok=True)


def _notes(folders: Iterable[Path], pattern: str) -> Iterator[tuple[Path, str | None]]:
    """This user's notes of a pattern: path and text of each, None as the text if the process that locked it is dead."""
    for folder in folders:
        for path in folder.glob(pattern):
            # It may be removed by now, or belong to another user.
            with contextlib.suppress(OSError), path.open(encoding="utf-8", errors=_ANY_BYTES) as file:
                if os.fstat(file.fileno()).st_uid == os.geteuid():
                    yield path, file.read() if is_locked(file.fileno()) else None


def _homes() -> list[Path]:
    """The parent folders of private folders, preferred first: the runtime folder of a user is removed at the logout."""
    homes = [os.environ.get("XDG_RUNTIME_DIR", "")]
    with contextlib.suppress(FileNotFoundError):  # there is no temporary folder that can be written to
        homes.insert(0, tempfile.gettempdir())
    return list(dict.fromkeys(Path(home) for home in homes if os.access(home, os.W_OK)))
