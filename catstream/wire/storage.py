"""Files of arrays and metadata in the safetensors format, with a checksum.

`pack` and `unpack` convert a message to arrays and metadata, and back.
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
#: JSON metadata by name. Code that reads a file checks the entries that it uses.
Metadata = dict[str, Any]

Message = TypeVar("Message")

_KEY = "catstream"  # the only metadata key: with several, their order, and so the bytes of the file, would vary
_ROOM = 1.1  # free space that is required for a file, in sizes of its arrays
_VERSION = 1  # version of the metadata's format


def write(path: str | os.PathLike[str], arrays: Arrays, metadata: Metadata, *, durable: bool = True) -> None:
    """Write arrays and JSON metadata to a file for its owner only, as `write_atomically` does; memory holds no copy.

    A file that is not durable survives the death of this process, and may be lost or damaged by a power cut.
    OSError if the file cannot be written; the old one stays unchanged. Without room for it, nothing is written, as the
    attempt would take the last bytes of the disk from the log of a run.
    """
    path = Path(path)
    remove_parts(path)
    if shutil.disk_usage(path.parent).free < _ROOM * sum(array.nbytes for array in arrays.values()):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    # In a folder of its own, because safetensors makes a file beside the one that it writes.
    with tempfile.TemporaryDirectory(".part", f".{path.name}.", path.parent, ignore_cleanup_errors=True) as folder:
        part, (contiguous, header) = Path(folder, path.name), _content(arrays, metadata)
        try:
            safetensors.numpy.save_file(contiguous, part, header)
        except safetensors.SafetensorError as error:
            code = int(found[1]) if (found := re.search(r"\(os error (\d+)\)", str(error))) else errno.EIO
            raise OSError(code, os.strerror(code)) from None
        if durable:
            sync(part)  # the content must be on disk before the new name
        part.replace(path)
    if durable:
        sync(path.parent)


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


def _checksum(arrays: Arrays, metadata: Metadata) -> int:
    """The CRC-32 of the metadata and of the arrays with their names, shapes and types."""
    check = zlib.crc32(json.dumps(metadata, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        check = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), check)
        check = zlib.crc32(array.data, check)
    return check


def pack(message: object, name: str) -> tuple[Arrays, Metadata]:
    """Arrays, their names beginning with `name`, and metadata for JSON.

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
    """The message that `pack` took, bit for bit; TypeError or ValueError if it is of another kind.

    The limits of its arrays are not checked: `catstream.wire.schema` does that.
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
