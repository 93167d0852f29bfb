"""Atomic writes, locks of the kernel, and safetensors files of arrays and facts with a checksum (no code in them)."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import tempfile
import time
import zlib
from pathlib import Path

import numpy as np

from catstream.errors import ProtocolError

__all__ = ["is_locked", "is_writable", "lock", "read", "write", "write_atomically"]

_KEY = "catstream"  # one metadata key only: with more, their order and so the bytes would vary
_VERSION = 1  # of what the metadata means
_PAUSE_SECONDS = 0.05  # between two attempts to lock


def write_atomically(path: str | os.PathLike[str], data: bytes, mode: int = 0o666) -> None:
    """Write a file beside its final name, then put it in place of the old one; it survives a power cut from then on.

    Parameters
    ----------
    mode : who may read and write it from its first byte on, but for what the umask takes away

    Raises
    ------
    OSError
        Where it cannot be written. What was there before stays as it was.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        part.unlink(missing_ok=True)  # what a power cut left would keep its mode
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # the new name must not be on disk before all that it names
        part.replace(path)
        _sync(path.parent)
    finally:
        with contextlib.suppress(OSError):  # of a disk that is read-only now; the next one writes over it
            part.unlink(missing_ok=True)


def is_writable(folder: Path) -> bool:
    """Whether a file can be made in a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def lock(handle: int, seconds: float = 0.0) -> bool:
    """Lock an open file or folder for this process alone; False if another process keeps it locked for `seconds`.

    The kernel releases the lock when the handle is closed, or when the process ends, however that happens.
    """
    from filelock import lock_descriptor

    deadline = time.monotonic() + seconds
    while not lock_descriptor(handle, blocking=False):
        if time.monotonic() >= deadline:
            return False
        time.sleep(_PAUSE_SECONDS)
    return True


def is_locked(handle: int) -> bool:
    """Whether another process has locked an open file.

    The question is asked with a shared lock, which filelock does not offer: two processes that ask at the same moment
    do not take each other for an owner.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False


def write(
    path: str | os.PathLike[str], arrays: dict[str, np.ndarray], facts: dict[str, object], mode: int = 0o666
) -> None:
    """Place a file of arrays and facts, with a mode as `write_atomically` takes it.

    Raises
    ------
    OSError
        As `write_atomically` does.
    """
    from safetensors.numpy import save

    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    metadata = {"version": _VERSION, "facts": facts, "checksum": _checksum(contiguous, facts)}
    write_atomically(path, save(contiguous, metadata={_KEY: json.dumps(metadata, sort_keys=True)}), mode)


def read(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read what `write` wrote.

    Raises
    ------
    ProtocolError
        Where the file is torn, damaged, or not one of ours.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata = json.loads((file.metadata() or {})[_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        facts = metadata["facts"]
        if metadata["version"] != _VERSION:
            raise ValueError(f"it is of version {metadata['version']}, this catstream reads {_VERSION}")
        if metadata["checksum"] != _checksum(arrays, facts):
            raise ValueError("its checksum does not fit")
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"{path} is not a whole file of catstream ({error}): take an older copy") from None
    return arrays, facts


def _sync(folder: Path) -> None:
    """Have the names in a folder on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _checksum(arrays: dict[str, np.ndarray], facts: dict[str, object]) -> int:
    """CRC-32 of everything: names, shapes, types, numbers and facts."""
    check = zlib.crc32(json.dumps(facts, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        check = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), check)
        check = zlib.crc32(array.data, check)
    return check
