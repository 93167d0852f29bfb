"""Atomic file writes, file locks, and files of arrays and metadata in the safetensors format with a checksum.

A message is kept as arrays and metadata, too: `pack` and `unpack`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import fcntl
import glob
import json
import os
import secrets
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import safetensors
import safetensors.numpy

from catstream.errors import CatstreamError, ProtocolError, ServiceError

#: Arrays by name.
Arrays = dict[str, np.ndarray]
#: JSON metadata by name. Code that reads a file checks the entries that it uses.
Metadata = dict[str, Any]

Message = TypeVar("Message")

_KEY = "catstream"  # the only metadata key: with several, their order, and so the bytes of the file, would vary
_VERSION = 1  # version of the metadata's format
ABANDONED_SECONDS = 600.0  #: after which nothing writes a part of a file any more


def state_home() -> Path:
    """The folder of what is kept for this user; RuntimeError if the user has none."""
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "catstream"


def write_atomically(path: str | os.PathLike[str], data: bytes, mode: int = 0o666) -> None:
    """Replace a file atomically; the new content then survives a power cut. The umask reduces the permissions `mode`.

    OSError if the file cannot be written; the old one stays unchanged.
    """
    path = Path(path)
    _remove_parts(path)
    with _written_beside(path, data, mode) as part:
        part.replace(path)


def create_atomically(path: str | os.PathLike[str], data: bytes) -> None:
    """Create a file for its owner only: it exists with its whole content, or not at all, also after a power cut.

    FileExistsError if it exists, also if two processes create it at the same moment; OSError if it cannot be written.
    """
    path = Path(path)
    with _written_beside(path, data, 0o600) as part:
        os.link(part, path)  # unlike a rename, this fails if the file exists


@contextlib.contextmanager
def _written_beside(path: Path, data: bytes, mode: int) -> Iterator[Path]:
    """A new file in the folder of `path` whose content is on disk; what the block does with it is then on disk, too.

    Its name is its own, so that several may write `path` at the same time. It is removed if the block leaves it there.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # the content must be on disk before the new name
        yield part
        _sync(path.parent)
    finally:
        with contextlib.suppress(OSError):  # the disk may have become read-only; a later write removes the file
            part.unlink(missing_ok=True)


def _remove_parts(path: Path) -> None:
    """Remove the unfinished files for a file that processes left when they were killed while writing it."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with contextlib.suppress(OSError):
            if part.stat().st_mtime < time.time() - ABANDONED_SECONDS:
                shutil.rmtree(part) if part.is_dir() else part.unlink()


@contextlib.contextmanager
def writing(path: str | os.PathLike[str], kind: type[CatstreamError] = ServiceError) -> Iterator[None]:
    """A block that writes a file, or into a folder: an OSError in it becomes an error of this kind, for a person."""
    try:
        yield
    except BrokenPipeError:  # the reader of standard output has ended, as `head` does: not an error of catstream
        raise
    except OSError as error:
        raise kind(f"cannot write {os.fspath(path)!r} ({error.strerror}): give another place") from None


def check_file(
    path: Path, *, overwrite: bool = True, made: Path | None = None, kind: type[CatstreamError] = ServiceError
) -> None:
    """Raise an error of this kind if a file exists and may not be replaced, or cannot be written.

    The folder `made` is made before the file, if it does not exist.
    """
    if path.exists() and not overwrite:
        raise kind(f"{path} exists already: replace it with --overwrite, or give another name")
    folder = path.parent.absolute()
    if made is not None and folder == made.absolute():
        folder = next(each for each in (folder, *folder.parents) if each.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            is_writable = not path.is_dir()
    except OSError:
        is_writable = False
    if not is_writable:
        raise kind(f"cannot write {path}: give a file in a folder that exists and that you may write to")


@contextlib.contextmanager
def descriptor(path: Path, flags: int = os.O_RDONLY) -> Iterator[int]:
    """A descriptor to lock a file or folder with; OSError if it cannot be opened.

    It is closed in a copy of this process that is forked, which would hold the lock for the rest of its own life.
    """
    handle, owner = os.open(path, flags, 0o600), os.getpid()
    _descriptors.add(handle)
    try:
        yield handle
    finally:
        if owner == os.getpid():
            _descriptors.remove(handle)
            _flock(handle, fcntl.LOCK_UN)  # a copy that is just beginning may have it yet
            os.close(handle)


_descriptors: set[int] = set()


def _close_descriptors() -> None:
    for handle in _descriptors:
        os.close(handle)
    _descriptors.clear()


os.register_at_fork(after_in_child=_close_descriptors)


def lock(handle: int, seconds: float = 0.0) -> bool:
    """Lock an open file or folder until it is closed or this process ends; False if another keeps it for `seconds`."""
    deadline = time.monotonic() + seconds
    while not (locked := _flock(handle, fcntl.LOCK_EX)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return locked


def is_locked(handle: int) -> bool:
    """Whether another process has locked an open file; asked with a shared lock, so that two may ask at once."""
    return not _flock(handle, fcntl.LOCK_SH)


def _flock(handle: int, kind: int) -> bool:
    """Lock an open file or folder without waiting; returns False if another process has locked it."""
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def write(path: str | os.PathLike[str], arrays: Arrays, metadata: Metadata) -> None:
    """Write arrays and JSON metadata to a file for its owner only, as `write_atomically` does; memory holds no copy.

    OSError if the file cannot be written; the old one stays unchanged.
    """
    path = Path(path)
    _remove_parts(path)
    # In a folder of its own, because safetensors makes a file beside the one that it writes.
    with tempfile.TemporaryDirectory(".part", f".{path.name}.", path.parent, ignore_cleanup_errors=True) as folder:
        part, (contiguous, header) = Path(folder, path.name), _content(arrays, metadata)
        try:
            safetensors.numpy.save_file(contiguous, part, header)
        except safetensors.SafetensorError as error:
            raise OSError(errno.EIO, str(error)) from None
        _sync(part)  # the content must be on disk before the new name
        part.replace(path)
    _sync(path.parent)


def read(path: str | os.PathLike[str]) -> tuple[Arrays, Metadata]:
    """The arrays and the metadata of a file that `write` wrote; ProtocolError if it is damaged or another file."""
    return decode(Path(path).read_bytes(), str(path))


def read_metadata(path: str | os.PathLike[str]) -> Metadata:
    """The metadata of a file, as `read` returns it; the arrays are only checked, not copied."""
    return _checked(Path(path).read_bytes(), str(path))[1]


def encode(arrays: Arrays, metadata: Metadata) -> bytes:
    """The content of the file that `write` writes."""
    return safetensors.numpy.save(*_content(arrays, metadata))


def _content(arrays: Arrays, metadata: Metadata) -> tuple[Arrays, dict[str, str]]:
    """The arrays and the metadata as safetensors takes them."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}  # as safetensors expects
    facts = {"version": _VERSION, "facts": metadata, "checksum": _checksum(contiguous, metadata)}
    return contiguous, {_KEY: json.dumps(facts, sort_keys=True)}


def decode(data: bytes, name: str) -> tuple[Arrays, Metadata]:
    """The arrays and the metadata in the content of a file, as `read` returns them; its name is for the error."""
    arrays, metadata = _checked(data, name)
    return {key: array.copy() for key, array in arrays.items()}, metadata


def _checked(data: bytes, name: str) -> tuple[Arrays, Metadata]:
    """The metadata and the arrays in the content of a file; the arrays are read-only and share its memory."""
    try:
        arrays = safetensors.numpy.load(data)  # it checks the header
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_KEY])
        metadata = header["facts"]
        if header["version"] != _VERSION:
            raise ValueError(f"it is of version {header['version']}, this catstream reads {_VERSION}")
        if header["checksum"] != _checksum(arrays, metadata):
            raise ValueError("its checksum does not match")
    except (safetensors.SafetensorError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ProtocolError(
            f"{name} is not an undamaged file of catstream ({error}): use an older copy, or a file that catstream wrote"
        ) from None
    return arrays, metadata


def with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names begin with a prefix, by the rest of their names."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _sync(path: Path) -> None:
    """Write the content of a file, or the entries of a folder, to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _checksum(arrays: Arrays, metadata: Metadata) -> int:
    """The CRC-32 of the metadata and of the arrays with their names, shapes and types."""
    check = zlib.crc32(json.dumps(metadata, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        check = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), check)
        check = zlib.crc32(array.data, check)
    return check


def pack(message: object, name: str) -> tuple[Arrays, Metadata]:
    """Arrays, their names beginning with `name`, and metadata for JSON.

    >>> from catstream.messages.kinds import Motion
    >>> arrays, metadata = pack(Motion(np.eye(4), np.eye(2)), "motion")
    >>> list(arrays), metadata
    (['motion.process', 'motion.observation'], {})
    >>> unpack(Motion, arrays, metadata, "motion").observation.tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    arrays: Arrays = {}
    values = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}  # type: ignore[arg-type]
    return arrays, _without_arrays(values, name, arrays)


def unpack(kind: type[Message], arrays: Arrays, metadata: Metadata, name: str) -> Message:
    """The message that `pack` took, bit for bit; TypeError or ValueError if it is none of this kind.

    The limits of its arrays are not checked: `catstream.messages.schema` does that.
    """
    whole: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(metadata))  # a copy, to put the arrays into
    for path, array in with_prefix(arrays, f"{name}.").items():
        *groups, last = path.split(".")
        place = whole
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = array
    return msgspec.convert(whole, kind, dec_hook=_array)


def _array(_: type, value: object) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise ValueError("expected an array")
    return value


def _without_arrays(values: dict[str, Any], name: str, arrays: Arrays) -> Metadata:
    """Values by name, as they are in JSON; arrays among them are moved to `arrays`."""
    metadata: Metadata = {}
    for key, value in values.items():
        path = f"{name}.{key}"
        if isinstance(value, np.ndarray):
            arrays[path] = value
        elif isinstance(value, dict):
            metadata[key] = _without_arrays(value, path, arrays)
        elif dataclasses.is_dataclass(value):
            parts, metadata[key] = pack(value, path)
            arrays.update(parts)
        else:
            metadata[key] = list(value) if isinstance(value, tuple) else value
    return metadata
