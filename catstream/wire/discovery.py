"""How processes of a user find one another: private folders with notes of the running pipelines and fleets.

A note is a file that is locked as long as its process lives, so that stale notes of killed processes are detected.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from catstream.base.files import descriptor, is_locked, lock, locked_folder, writing
from catstream.base.forks import forked, generation
from catstream.errors import ServiceError
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint, is_too_long, socket_files
from catstream.wire.keys import clients

#: Ports that streams listen on, below those that the kernel gives to connections: each has a block of them.
PORTS = range(21000, 32000, 1 + max(channel.port + len(channel.senders) for channel in CHANNELS.values()))

_PREFIX = "catstream-"  # of private folders
_OWNER = "owner"  # file in a private folder, locked while its owner lives
_NOTE = "endpoint"  # note in the private folder of a running pipeline: its endpoint, folder of keys, and source
_FLEET_NOTE = "fleet-endpoint"  # the same of the controller of a fleet: its endpoint, folder of keys, and name
_ANY_BYTES = "surrogateescape"  # in notes: the name of a file need not be UTF-8


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder that only this user may enter, removed afterwards; also removes the folders of killed processes.

    It is locked, as programs that remove old temporary files leave a locked folder alone (systemd-tmpfiles).
    """
    if not (bases := _base_folders()):
        raise ServiceError("no folder for temporary files can be written to: set TMPDIR to one")
    base = next((base for base in bases if not is_too_long(base / f"{_PREFIX}12345678")), bases[0])
    for path, text in _notes([base], f"{_PREFIX}*/{_OWNER}"):
        if text is None:
            shutil.rmtree(path.parent, ignore_errors=True)
    with contextlib.ExitStack() as stack:
        with writing(base):
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            lock(stack.enter_context(descriptor(folder, os.O_DIRECTORY)))
            stack.enter_context(note(folder / _OWNER, ""))
        since = generation()
        try:
            yield folder
        finally:
            if forked(since):
                stack.pop_all()


@contextlib.contextmanager
def reserve_endpoint(text: str, default: Path, keys: str = "", source: str = "", fleet: str = "") -> Iterator[Endpoint]:
    """The endpoint of one pipeline, or of the registry of a fleet, locked for it; removes all socket files afterwards.

    `text` and `keys` are settings. The private folder `default` is used if `text` is empty, and the endpoint is found
    by a note in it, with the source of the frames, without a password, or the name of the fleet.
    """
    endpoint = Endpoint.parse(text or str(default), keys)
    if endpoint.keys is not None:  # otherwise its own processes would wait until the file is correct
        endpoint.keys.listening()
        clients(endpoint.keys.folder)
    with contextlib.ExitStack() as stack:
        if text and endpoint.folder is not None:  # of tcp, the kernel gives a port to one process only
            folder = stack.enter_context(_locked(endpoint.folder.absolute(), text))
            endpoint = Endpoint.parse(str(folder), endpoint.keys or "")
        facts = str(endpoint), str(endpoint.keys.folder) if endpoint.keys is not None else "", fleet or source
        with writing(default):
            stack.enter_context(note(default / (_FLEET_NOTE if fleet else _NOTE), "\n".join(facts)))
        yield endpoint


@contextlib.contextmanager
def _locked(folder: Path, text: str) -> Iterator[Path]:
    """A folder for the sockets of one pipeline, which is made; the sockets are removed afterwards."""
    busy = f"a pipeline is already running on {text!r}: wait for it, or use another folder (--set run.endpoint=FOLDER)"
    with locked_folder(folder, mode=0o700, busy=busy):
        facts = folder.stat()
        if facts.st_uid != os.geteuid() or facts.st_mode & 0o022:
            raise ServiceError(f"other users may write to {text!r}: use a folder of your own, chmod 700")
        since = generation()
        try:
            yield folder
        finally:
            if not forked(since):
                for file in socket_files(folder):
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
    for _, text in _notes(_base_folders(), f"{_PREFIX}*/{note}"):
        if text:
            endpoint, keys, about = [*text.split("\n", 2), "", ""][:3]  # another version may write less
            try:
                yield Endpoint.parse(endpoint, keys), about
            except ServiceError:
                if strict:
                    raise


def find() -> Endpoint:
    """The endpoint of the user's only running pipeline; its keys are in its note.

    ServiceError if there is none, or more than one.
    """
    endpoints = running()
    if not endpoints:
        list(_endpoints(_NOTE, strict=True))  # raises the error of a pipeline whose keys cannot be read
        raise ServiceError("no pipeline of yours is running: start one (catstream track), or pass its --endpoint")
    if len(endpoints) > 1:
        places = "; ".join(sorted(f"{endpoint.source or 'a pipeline'} at {endpoint}" for endpoint in endpoints))
        raise ServiceError(f"{len(endpoints)} pipelines are running: select one (--endpoint); {places}")
    return endpoints[0]


def source_at(endpoint: Endpoint) -> str:
    """The source of the pipeline at an endpoint, if that is one of this user; empty if it is not known."""
    if endpoint.source:
        return endpoint.source
    text = str(endpoint.folder.absolute()) if endpoint.folder is not None else str(endpoint)
    return next((other.source for other in running() if str(other) == text), "")


@contextlib.contextmanager
def note(path: Path, text: str) -> Iterator[None]:
    """A file that is locked as long as its process uses it; it is never visible without its lock and text."""
    hidden, since = path.with_name(f".{path.name}"), generation()
    with descriptor(hidden, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as handle:
        try:
            lock(handle, math.inf)
            os.write(handle, text.encode(errors=_ANY_BYTES))
            hidden.rename(path)
            yield
        finally:
            if not forked(since):
                hidden.unlink(missing_ok=True)
                path.unlink(missing_ok=True)


def _notes(folders: Iterable[Path], pattern: str) -> Iterator[tuple[Path, str | None]]:
    """This user's notes of a pattern: path and text of each, None as the text if the process that locked it is dead."""
    for folder in folders:
        for path in folder.glob(pattern):
            # It may have been removed, or belong to another user.
            with contextlib.suppress(OSError), path.open(encoding="utf-8", errors=_ANY_BYTES) as file:
                if os.fstat(file.fileno()).st_uid == os.geteuid():
                    yield path, file.read() if is_locked(file.fileno()) else None


def _base_folders() -> list[Path]:
    """The parent folders of private folders, preferred first: the runtime folder of a user is removed at the logout."""
    bases = [os.environ.get("XDG_RUNTIME_DIR", "")]
    with contextlib.suppress(FileNotFoundError):  # there is no temporary folder that can be written to
        bases.insert(0, tempfile.gettempdir())
    return list(dict.fromkeys(Path(base) for base in bases if os.access(base, os.W_OK)))


def free_ports(address: str, stack: contextlib.ExitStack) -> int:
    """The first of some ports of this node that are free, and that no other stream takes while the stack is open."""
    while True:
        first = random.choice(PORTS)
        with contextlib.ExitStack() as block, contextlib.suppress(OSError):
            reserved = block.enter_context(socket.socket(socket.AF_UNIX))
            reserved.bind(f"\0catstream-ports-{first}")  # the kernel frees it if this process dies
            with contextlib.ExitStack() as probes:
                for port in range(first, first + PORTS.step):
                    probes.enter_context(socket.socket()).bind((address, port))
            stack.enter_context(block.pop_all())
            return first
