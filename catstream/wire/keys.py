"""CURVE keys of a pipeline, and the clients that may connect, with their roles.

A pipeline that other machines can reach has a folder of keys, created by `catstream keys new`:

    server.key       key pair of the listening sockets
    server.pub       its public key, by which clients recognise the pipeline
    client.key       key pair of the pipeline's own processes
    clients/NAME     a client that may connect: its role and its public key

A client has a folder with `server.pub` and its own `client.key`. Every file is TOML, and created with private
permissions. The files in `clients` are read at each handshake: adding or removing one allows or revokes a client
without a restart. All errors are ServiceErrors.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import zmq

from catstream.base.files import create_atomically, write_atomically, writing
from catstream.errors import ServiceError
from catstream.wire.channels import Role

#: The permissions of a client: each role includes those before it.
ROLES: tuple[Role, ...] = get_args(Role)

_SERVER, _SERVER_PUBLIC, _CLIENT, _CLIENTS = "server.key", "server.pub", "client.key", "clients"
_OWN = "pipeline"  # client name of the pipeline's own processes
_FLEET = "fleet.pipeline"  # client name of the fleet's own processes at its streams
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_KEY = re.compile(r"[0-9a-zA-Z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")  # Z85, ZeroMQ's encoding of keys
_MAX_BYTES = 4096  # of a file that is read


@dataclass(frozen=True, slots=True)
class Client:
    """A client that may connect: its role and its public key."""

    role: Role
    public: str


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of a process, and the folder of the clients that may connect to it.

    server          public key of the listening sockets
    public, secret  key pair of the sockets that connect
    """

    folder: Path
    server: bytes
    public: bytes
    secret: bytes = field(repr=False)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Keys:
        """Load the keys of a pipeline or of a client."""
        folder = Path(folder).absolute()
        public, secret = (_key(folder / _CLIENT, name).encode() for name in ("public", "secret"))
        return cls(folder, public_key(folder).encode(), public, secret)

    def listening(self) -> bytes:
        """The secret key of the listening sockets."""
        return _key(self.folder / _SERVER, "secret").encode()


def create(folder: Path) -> None:
    """Create the keys of a pipeline: a pair for its listening sockets, and one for its own processes."""
    if any((folder / name).exists() for name in (_SERVER, _SERVER_PUBLIC, _CLIENT, _CLIENTS)):
        raise ServiceError(f"{folder} contains keys already: use another folder, or its clients would be locked out")
    _write(folder / _SERVER_PUBLIC, public=_pair(folder / _SERVER))
    _write(folder / _CLIENTS / _OWN, role="pipeline", public=_pair(folder / _CLIENT))


def ensure(folder: Path) -> None:
    """Create the keys of a pipeline, unless the folder contains them already."""
    if not (folder / _CLIENTS / _OWN).exists():  # the last file that `create` writes
        create(folder)


def allow(folder: Path, name: str, role: Role, output: Path) -> None:
    """Create keys for a client in the new folder `output`, and allow it to connect from now on."""
    if not _NAME.fullmatch(name):
        raise ServiceError(f"expected a client name of at most 64 letters, digits, dots and dashes, got {name!r}")
    if name in clients(folder):
        raise ServiceError(f"a client {name} exists already: use another name, or remove {folder / _CLIENTS / name}")
    _write(output / _SERVER_PUBLIC, public=public_key(folder))
    _write(folder / _CLIENTS / name, role=role, public=_pair(output / _CLIENT))


def clients(folder: Path) -> dict[str, Client]:
    """The clients that may connect, by name."""
    by_name = {}
    try:
        paths = sorted(path for path in (folder / _CLIENTS).iterdir() if _NAME.fullmatch(path.name))
    except OSError as error:
        raise ServiceError(f"no keys in {folder} ({error.strerror}): make them with `catstream keys new`") from None
    for path in paths:
        try:
            if (role := _read(path).get("role")) not in ROLES:
                raise ServiceError(f"{path}: expected the role {', '.join(ROLES)}, got {role!r}: correct or remove it")
            by_name[path.name] = Client(role, _key(path, "public"))
        except ServiceError:
            if path.exists():  # otherwise the client was just revoked
                raise
    return by_name


def synchronise(folder: Path, desired: Mapping[str, Client]) -> None:
    """Allow at a stream only its own processes and the clients of its fleet."""
    texts = {_FLEET if name == _OWN else name: _text(**asdict(client)) for name, client in desired.items()}
    with writing(folder / _CLIENTS):
        for path in (folder / _CLIENTS).iterdir():
            if path.name not in (_OWN, *texts):
                path.unlink(missing_ok=True)
        for name, text in texts.items():
            write_atomically(folder / _CLIENTS / name, text, mode=0o600)


def public_key(folder: Path) -> str:
    """The public key of the listening sockets."""
    return _key(folder / _SERVER_PUBLIC, "public")


def _pair(path: Path) -> str:
    """Create a key pair in a new file; returns the public key."""
    public, secret = (key.decode() for key in zmq.curve_keypair())
    _write(path, public=public, secret=secret)
    return public


def _write(path: Path, **facts: str) -> None:
    """Write a new private file atomically."""
    with writing(path):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            create_atomically(path, _text(**facts))
        except FileExistsError:
            raise ServiceError(f"{path} exists already and is not overwritten: use another folder") from None


def _text(**facts: str) -> bytes:
    """The content of a file in TOML."""
    return "".join(f'{name} = "{value}"\n' for name, value in facts.items()).encode()


def _key(path: Path, name: str) -> str:
    """The key of this name in a file."""
    key = _read(path).get(name)
    if not isinstance(key, str) or not _KEY.fullmatch(key):
        raise ServiceError(f"{path} contains no valid {name} key (40 characters of Z85): make new keys")
    return key


def _read(path: Path) -> dict[str, Any]:
    """Read a file. ServiceError if another user may write it, or read it if it contains a secret key."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if status.st_uid not in (os.geteuid(), 0) or status.st_mode & (0o077 if path.suffix == ".key" else 0o022):
                raise ServiceError(
                    f"other users can access {path}: chmod 600, and make new keys if others may have read it"
                )
            return tomllib.loads(file.read(_MAX_BYTES).decode())
    except OSError as error:
        raise ServiceError(
            f"cannot read {path} ({error.strerror}): a pipeline needs a folder made by `catstream keys new`, and a "
            "client needs one made by `catstream keys allow`"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ServiceError(f"{path} is damaged ({error}): make new keys") from None
