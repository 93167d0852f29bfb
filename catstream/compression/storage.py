"""Arrays and facts in one safetensors file: whole or not at all, and no code in it."""

from __future__ import annotations

import json
import os
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
        save_file(contiguous, part, metadata={_KEY: json.dumps(facts, sort_keys=True)})
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Read what `write` wrote.

    Raises
    ------
    ProtocolError
        Where the file is torn, or not one of ours.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {})[_KEY])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError) as error:
        raise ProtocolError(f"{path} is not a whole file of catstream ({error}): take an older copy") from None
    return arrays, facts
