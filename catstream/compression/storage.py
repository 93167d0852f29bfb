"""Arrays and facts in one safetensors file: whole or not at all, checked, and no code in it."""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path

import numpy as np

from catstream.errors import ProtocolError

__all__ = ["read", "write"]

_KEY = "catstream"  # one metadata key only: with more, their order and so the bytes would vary


def write(path: str | os.PathLike[str], arrays: dict[str, np.ndarray], facts: dict[str, object]) -> None:
    """Write a file beside its final name, then put it in place of the old one."""
    from safetensors.numpy import save_file

    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        text = json.dumps({"facts": facts, "checksum": _checksum(contiguous, facts)}, sort_keys=True)
        save_file(contiguous, part, metadata={_KEY: text})
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


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
            told = json.loads((file.metadata() or {})[_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        facts = told["facts"]
        if told["checksum"] != _checksum(arrays, facts):
            raise ValueError("its checksum does not fit")
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ProtocolError(f"{path} is not a whole file of catstream ({error}): take an older copy") from None
    return arrays, facts


def _checksum(arrays: dict[str, np.ndarray], facts: dict[str, object]) -> int:
    """CRC-32 of everything: names, shapes, types, numbers and facts."""
    check = zlib.crc32(json.dumps(facts, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        check = zlib.crc32(f"{name} {array.dtype} {array.shape}".encode(), check)
        check = zlib.crc32(array.data, check)
    return check
