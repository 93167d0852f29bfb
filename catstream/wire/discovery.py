"""Discovery of a user's running pipelines and fleets by lock files in private folders.

A lock file contains an endpoint and is locked while its process lives, so stale files of killed processes are detected.
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

#: First port of the block of each stream, below the kernel's ephemeral ports.
PORTS = range(21000, 32000, 1 + max(channel.port + len(channel.senders) for channel in CHANNELS.values()))

_PREFIX = "catstream-"  # of private folders
_LOCK = "lock"  # lock file in every private folder, without content
_PIPELINE = "endpoint"  # lock file of a pipeline: its endpoint, folder of keys, and source
_FLEET = "fleet-endpoint"  # lock file of a fleet's controller: its endpoint, folder of keys, and name
_ANY_BYTES = "surrogateescape"  # for lock files: a file name need not be UTF-8


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder that only this user may enter, removed afterwards; also removes the folders of killed processes.

    It is locked, because programs that remove old temporary files skip a locked folder (systemd-tmpfiles).
    """
    if not (bases := _base_folders()):
        raise ServiceError("no folder for temporary files is writable: set TMPDIR to one")
    base = next((base for base in bases if not is_too_long(base / f"{_PREFIX}12345678")), bases[0])
    for path, text in _lock_files([base], f"{_PREFIX}*/{_LOCK}"):
        if text is None:
            shutil.rmtree(path.parent, ignore_errors=True)
    with contextlib.ExitStack() as stack:
        with writing(base):
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=base))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            lock(stack.enter_context(descriptor(folder, os.O_DIRECTORY)))
            stack.enter_context(lock_file(folder / _LOCK, ""))
        since = generation()
        try:
            yield folder
        finally:
            if forked(since):
                stack.pop_all()


@contextlib.contextmanager
def reserve_endpoint(text: str, default: Path, keys: str = "", source: str = "", fleet: str = "") -> Iterator[Endpoint]:
    """Lock the endpoint of a pipeline, or of a fleet's registry; removes all socket files afterwards.

    `text` and `keys` are settings. If `text` is empty, the private folder `default` is the endpoint. A lock file in it
    makes the endpoint discoverable, with the source of the frames (without a password) or the name of the fleet.
    """
    endpoint = Endpoint.parse(text or str(default), keys)
    if endpoint.keys is not None:  # fail early: the pipeline's processes would wait until the files are valid
        endpoint.keys.listening()
        clients(endpoint.keys.folder)
    with contextlib.ExitStack() as stack:
        if text and endpoint.folder is not None:  # with tcp, the kernel gives a port to one process only
            folder = stack.enter_context(_locked(endpoint.folder.absolute(), text))
            endpoint = Endpoint.parse(str(folder), endpoint.keys or "")
        lines = str(endpoint), str(endpoint.keys.folder) if endpoint.keys is not None else "", fleet or source
        with writing(default):
            stack.enter_context(lock_file(default / (_FLEET if fleet else _PIPELINE), "\n".join(lines)))
        yield endpoint


@contextlib.contextmanager
def _locked(folder: Path, text: str) -> Iterator[Path]:
    """Create and lock a folder for the sockets of one pipeline; removes the sockets afterwards."""
    busy = f"a pipeline is already running on {text!r}: wait for it, or use another folder (--set run.endpoint=FOLDER)"
    with locked_folder(folder, mode=0o700, busy=busy):
        status = folder.stat()
        if status.st_uid != os.geteuid() or status.st_mode & 0o022:
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
    return [replace(endpoint, source=source) for endpoint, source in _endpoints(_PIPELINE)]


def fleets() -> dict[str, Endpoint]:
    """Endpoints of this user's fleet controllers on this machine, by the name of the fleet."""
    return {name: endpoint for endpoint, name in _endpoints(_FLEET)}


def _endpoints(file: str, *, strict: bool = False) -> Iterator[tuple[Endpoint, str]]:
    """Endpoint and source (or name) in each lock file of this name whose process is running.

    An endpoint whose keys cannot be read is skipped, or an error if `strict`.
    """
    for _, text in _lock_files(_base_folders(), f"{_PREFIX}*/{file}"):
        if text:
            endpoint, keys, about = [*text.split("\n", 2), "", ""][:3]  # another version may write fewer lines
            try:
                yield Endpoint.parse(endpoint, keys), about
            except ServiceError:
                if strict:
                    raise


def find() -> Endpoint:
    """The endpoint of the user's only running pipeline, with its keys; ServiceError if not exactly one is running."""
    endpoints = running()
    if not endpoints:
        list(_endpoints(_PIPELINE, strict=True))  # raises the error of a pipeline whose keys cannot be read
        raise ServiceError("no pipeline of yours is running: start one (catstream track), or pass its --endpoint")
    if len(endpoints) > 1:
        listing = "; ".join(sorted(f"{endpoint.source or 'a pipeline'} at {endpoint}" for endpoint in endpoints))
        raise ServiceError(f"{len(endpoints)} pipelines are running: select one (--endpoint); {listing}")
    return endpoints[0]


def source_at(endpoint: Endpoint) -> str:
    """The source of this user's pipeline at an endpoint; empty if it is unknown."""
    if endpoint.source:
        return endpoint.source
    text = str(endpoint.folder.absolute()) if endpoint.folder is not None else str(endpoint)
    return next((other.source for other in running() if str(other) == text), "")


@contextlib.contextmanager
def lock_file(path: Path, text: str) -> Iterator[None]:
    """Create a lock file, and remove it afterwards; it appears atomically with its lock and its text."""
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


def _lock_files(folders: Iterable[Path], pattern: str) -> Iterator[tuple[Path, str | None]]:
    """Path and text of this user's lock files that match a pattern; the text is None if the process is dead."""
    for folder in folders:
        for path in folder.glob(pattern):
            # The file may be gone, or belong to another user.
            with contextlib.suppress(OSError), path.open(encoding="utf-8", errors=_ANY_BYTES) as file:
                if os.fstat(file.fileno()).st_uid == os.geteuid():
                    yield path, file.read() if is_locked(file.fileno()) else None


def _base_folders() -> list[Path]:
    """Parent folders of private folders, preferred first; the user's runtime folder is last, as logout removes it."""
    bases = [os.environ.get("XDG_RUNTIME_DIR", "")]
    with contextlib.suppress(FileNotFoundError):  # no temporary folder is writable
        bases.insert(0, tempfile.gettempdir())
    return list(dict.fromkeys(Path(base) for base in bases if os.access(base, os.W_OK)))


def free_ports(address: str, stack: contextlib.ExitStack) -> int:
    """First port of a free block on this node, reserved against other streams until the stack is closed."""
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
