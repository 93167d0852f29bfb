"""Files of arrays and metadata in the safetensors format, with a checksum.

`pack` converts a message to arrays and metadata, and `unpack` back.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import shutil
import tempfile
import zlib
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import safetensors
import safetensors.numpy

from catstream.base.files import remove_parts, sync
from catstream.errors import ProtocolError

#: Arrays by name.
Arrays = dict[str, np.ndarray]
#: JSON metadata by name. Readers validate the entries that they use.
Metadata = dict[str, Any]

Message = TypeVar("Message")

_KEY = "catstream"  # the only metadata key: the order of several, and thus the file's bytes, would vary
_ROOM = 1.1  # required free space, as a multiple of the size of the arrays
_VERSION = 1  # of the metadata's format


def write(path: str | os.PathLike[str], arrays: Arrays, metadata: Metadata, *, durable: bool = True) -> None:
    """Write arrays and JSON metadata to a private file atomically, without a copy in memory.

    A file that is not durable survives the death of this process; a power cut may lose or damage it.
    OSError if the file cannot be written; the old one stays unchanged. If the disk lacks space, nothing is written:
    the attempt would use up the space for the log of the run.
    """
    path = Path(path)
    remove_parts(path)
    if shutil.disk_usage(path.parent).free < _ROOM * sum(array.nbytes for array in arrays.values()):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    # A temporary folder, because safetensors creates a second file next to its output.
    with tempfile.TemporaryDirectory(".part", f".{path.name}.", path.parent, ignore_cleanup_errors=True) as folder:
        part, (contiguous, header) = Path(folder, path.name), _content(arrays, metadata)
        try:
            safetensors.numpy.save_file(contiguous, part, header)
        except safetensors.SafetensorError as error:
            code = int(match[1]) if (match := re.search(r"\(os error (\d+)\)", str(error))) else errno.EIO
            raise OSError(code, os.strerror(code)) from None
        if durable:
            sync(part)  # the content must be on disk before the new name
        part.replace(path)
    if durable:
        sync(path.parent)


def read(path: str | os.PathLike[str]) -> tuple[Arrays, Metadata]:
    """Read the arrays and the metadata of a file; ProtocolError if it is damaged or `write` did not write it."""
    return decode(Path(path).read_bytes(), str(path))


def read_metadata(path: str | os.PathLike[str]) -> Metadata:
    """Read the metadata of a file; the arrays are validated but not copied."""
    return _checked(Path(path).read_bytes(), str(path))[1]


def encode(arrays: Arrays, metadata: Metadata) -> bytes:
    """Return the content of a file as bytes."""
    return safetensors.numpy.save(*_content(arrays, metadata))


def _content(arrays: Arrays, metadata: Metadata) -> tuple[Arrays, dict[str, str]]:
    """The arrays and the header in the form that safetensors accepts."""
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    facts = {"version": _VERSION, "facts": metadata, "checksum": _checksum(contiguous, metadata)}
    return contiguous, {_KEY: json.dumps(facts, sort_keys=True)}


def decode(data: bytes, name: str) -> tuple[Arrays, Metadata]:
    """Return the arrays and the metadata in the content of a file; `name` is for the error message."""
    arrays, metadata = _checked(data, name)
    return {key: array.copy() for key, array in arrays.items()}, metadata


def _checked(data: bytes, name: str) -> tuple[Arrays, Metadata]:
    """The arrays and the metadata in the content of a file; the arrays are read-only and share its memory."""
    try:
        arrays = safetensors.numpy.load(data)  # it checks the header
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][_KEY])
        metadata = header["facts"]
        if header["version"] != _VERSION:
            raise ValueError(f"expected version {_VERSION}, got {header['version']}")
        if header["checksum"] != _checksum(arrays, metadata):
            raise ValueError("its checksum does not match")
    except (safetensors.SafetensorError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ProtocolError(
            f"{name} is damaged or not a file of catstream ({error}): use an older copy, or a file that catstream wrote"
        ) from None
    return arrays, metadata


def with_prefix(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names start with a prefix, by their names without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _checksum(arrays: Arrays, metadata: Metadata) -> int:
    """CRC-32 of the metadata, and of the arrays with their names, shapes and types."""
    check = zlib.crc32(json.dumps(metadata, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        check = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), check)
        check = zlib.crc32(array.data, check)
    return check


def pack(message: object, name: str) -> tuple[Arrays, Metadata]:
    """Convert a message to arrays, their names prefixed with `name`, and JSON metadata.

    >>> from catstream.wire.messages import Motion
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
    """Restore a message of `pack` bit for bit; TypeError or ValueError if it is of another kind.

    The limits of its arrays are not checked: `catstream.wire.schema` does that.
    """
    values: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(metadata))  # a deep copy
    for path, array in with_prefix(arrays, f"{name}.").items():
        *groups, last = path.split(".")
        group_values = values
        for group in groups:
            group_values = group_values.setdefault(group, {})
        group_values[last] = array
    return msgspec.convert(values, kind, dec_hook=_array)


def _array(_: type, value: object) -> np.ndarray:
    if not isinstance(value, np.ndarray):
        raise ValueError("expected an array")
    return value


def _without_arrays(values: dict[str, Any], name: str, arrays: Arrays) -> Metadata:
    """Convert values by name to JSON; arrays among them are moved to `arrays`."""
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
