"""CURVE keys of a pipeline, and the list of clients that may connect, with their roles.

A pipeline that can be reached from other machines has a folder of keys, made by `catstream keys new`:

    server.key       key pair of the sockets that listen
    server.pub       its public key, by which clients recognise the pipeline
    client.key       key pair of the pipeline's own processes, for the sockets that connect
    clients/NAME     a client that may connect: its role and its public key

A client has a folder with `server.pub` and its own `client.key`. Every file is TOML, and only its owner can read it,
from its first byte on. The files in `clients` are read at each handshake, so a client can be added or removed without
a restart. What is wrong with a folder of keys is a ServiceError.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import zmq

from catstream.base.files import create_atomically, write_atomically, writing
from catstream.errors import ServiceError
from catstream.wire.channels import Role

#: The permissions of a client: each role includes those before it.
ROLES: tuple[Role, ...] = get_args(Role)

_SERVER, _SERVER_PUBLIC, _CLIENT, _CLIENTS = "server.key", "server.pub", "client.key", "clients"
_OWN = "pipeline"  # the name of the pipeline's own processes among the clients
_FLEET = "fleet.pipeline"  # the name of the fleet's own processes among the clients of its streams
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_KEY = re.compile(r"[0-9a-zA-Z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")  # Z85, as ZeroMQ writes a key
_LONGEST = 4096  # bytes of a file


@dataclass(frozen=True, slots=True)
class Client:
    """A client that may connect: its role and its public key."""

    role: Role
    public: str


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys with which a process connects, and the folder of the clients that may connect to it.

    server          public key of the sockets that listen
    public, secret  key pair of the sockets that connect
    """

    folder: Path
    server: bytes
    public: bytes
    secret: bytes = field(repr=False)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Keys:
        """Read a folder of keys, a pipeline's or a client's."""
        folder = Path(folder).absolute()
        public, secret = (_key(folder / _CLIENT, name).encode() for name in ("public", "secret"))
        return cls(folder, public_key(folder).encode(), public, secret)

    def listening(self) -> bytes:
        """The secret key of the sockets that listen."""
        if not (self.folder / _SERVER).exists():
            raise ServiceError(
                f"{self.folder} holds the keys of a client, a pipeline needs those that `catstream keys new` made: "
                "pass that folder"
            )
        return _key(self.folder / _SERVER, "secret").encode()

    def for_server(self, public: str) -> Keys:
        """The same key pair, to connect to sockets with another public key."""
        return replace(self, server=_checked(public).encode())

    def client(self, public: str) -> tuple[str, Role] | None:
        """Current name and role of the client with this public key; None if it is not allowed to connect."""
        allowed = clients(self.folder)
        return next(((name, client.role) for name, client in allowed.items() if client.public == public), None)


def create(folder: Path) -> None:
    """Make the keys of a pipeline: a pair for its sockets that listen, and one for its processes that connect."""
    if any((folder / name).exists() for name in (_SERVER, _SERVER_PUBLIC, _CLIENT, _CLIENTS)):
        raise ServiceError(
            f"{folder} holds keys already, and clients that have them would be locked out: use another folder"
        )
    _write(folder / _SERVER_PUBLIC, public=_pair(folder / _SERVER))
    _write(folder / _CLIENTS / _OWN, role="pipeline", public=_pair(folder / _CLIENT))


def ensure(folder: Path) -> None:
    """Make the keys of a pipeline as `create`, unless the folder holds them already."""
    if not (folder / _CLIENTS / _OWN).exists():  # which is made last
        create(folder)


def allow(folder: Path, name: str, role: Role, output: Path | None = None, public: str | None = None) -> None:
    """Add a client, which may connect from now on: with keys in the new folder `output`, or with its own public key."""
    others, server = clients(folder), public_key(folder)
    if _named(name) in others:
        raise ServiceError(f"there is a client {name} already: take another name, or `catstream keys revoke` it first")
    for other, client in others.items():
        if client.public == public:
            raise ServiceError(f"this key is that of {other}, a {client.role} client: `catstream keys revoke` it first")
    if public is not None:
        _checked(public)
    elif output is not None:
        _write(output / _SERVER_PUBLIC, public=server)
        public = _pair(output / _CLIENT)
    else:
        raise ServiceError("a new client needs a folder for its keys, or its public key")
    _write(folder / _CLIENTS / name, role=role, public=public)


def revoke(folder: Path, name: str) -> None:
    """Remove a client, also one whose file is damaged: it cannot connect any more."""
    names = [path.name for path in _listed(folder)]
    if name not in names:
        raise ServiceError(f"no client named {name!r} (clients: {', '.join(names)})")
    if name == _OWN:
        raise ServiceError(f"{name!r} is the key of the pipeline itself: to replace it, make keys in another folder")
    with writing(folder / _CLIENTS):
        (folder / _CLIENTS / name).unlink(missing_ok=True)


def allowed(folder: Path) -> dict[str, Client]:
    """The clients that a fleet with these keys allows at its streams, by name: its own processes are one of them."""
    return {_FLEET if name == _OWN else name: client for name, client in clients(folder).items()}


def synchronise(folder: Path, desired: Mapping[str, Client]) -> None:
    """Allow these clients and no others, besides the pipeline's own processes; all others are revoked.

    A client that stays is allowed at any time. A connection that is open stays open.
    """
    texts = {
        _named(name): _text(role=client.role, public=_checked(client.public))
        for name, client in desired.items()
        if name != _OWN
    }
    present = {path.name for path in _listed(folder)} - {_OWN}
    with writing(folder / _CLIENTS):
        for name in present - texts.keys():
            (folder / _CLIENTS / name).unlink(missing_ok=True)
        for name, text in texts.items():
            path = folder / _CLIENTS / name
            if name not in present or path.read_bytes() != text:
                write_atomically(path, text, mode=0o600)


def clients(folder: Path) -> dict[str, Client]:
    """The clients that may connect, by name."""
    by_name = {}
    for path in _listed(folder):
        try:
            if (role := _read(path).get("role")) not in ROLES:
                raise ServiceError(
                    f"{path} gives the role {role!r}, there are {', '.join(ROLES)}: revoke it, and allow it again"
                )
            by_name[path.name] = Client(role, _key(path, "public"))
        except ServiceError:
            if path.exists():  # otherwise it was revoked meanwhile
                raise
    return by_name


def public_key(folder: Path) -> str:
    """The public key of the sockets that listen."""
    return _key(folder / _SERVER_PUBLIC, "public")


def _listed(folder: Path) -> list[Path]:
    """The files of the clients."""
    try:
        return sorted(path for path in (folder / _CLIENTS).iterdir() if _NAME.fullmatch(path.name))
    except OSError as error:
        raise ServiceError(f"no keys in {folder} ({error.strerror}): make them with `catstream keys new`") from None


def _named(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ServiceError(f"a client's name is of letters, digits, dots and dashes, at most 64, got {name!r}")
    return name


def _checked(public: str) -> str:
    if not _KEY.fullmatch(public):
        raise ServiceError(f"a public key is 40 characters of Z85, got {public!r}")
    return public


def _pair(path: Path) -> str:
    """Make a key pair in a new file; returns the public key."""
    public, secret = (key.decode() for key in zmq.curve_keypair())
    _write(path, public=public, secret=secret)
    return public


def _write(path: Path, **facts: str) -> None:
    """Write a new file atomically; only its owner can read it at any time."""
    with writing(path):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            create_atomically(path, _text(**facts))  # beside a file whose name begins with a dot, as no client's does
        except FileExistsError:
            raise ServiceError(f"{path} exists already and is not overwritten: use another folder") from None


def _text(**facts: str) -> bytes:
    """The content of a file, as TOML."""
    return "".join(f'{name} = "{value}"\n' for name, value in facts.items()).encode()


def _key(path: Path, name: str) -> str:
    """The key of this name in a file."""
    key = _read(path).get(name)
    if not isinstance(key, str) or not _KEY.fullmatch(key):
        raise ServiceError(f"{path} holds no {name} key as ZeroMQ writes it, 40 characters: make new keys")
    return key


def _read(path: Path) -> dict[str, Any]:
    """The content of a file; only its owner may write it, and read it if it holds a secret key."""
    try:
        with path.open("rb") as file:
            facts = os.fstat(file.fileno())
            if facts.st_uid not in (os.geteuid(), 0) or facts.st_mode & (0o077 if path.suffix == ".key" else 0o022):
                raise ServiceError(
                    f"other users can access {path}: chmod 600, and make new keys if somebody may have read it"
                )
            return tomllib.loads(file.read(_LONGEST).decode())
    except OSError as error:
        raise ServiceError(
            f"cannot read {path} ({error.strerror}): a folder of keys is made with `catstream keys new` for a "
            "pipeline, with `catstream keys allow` for a client"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ServiceError(f"{path} is damaged ({error}): make new keys") from None
