"""Messages to bytes and back; nothing that arrives is believed before it is checked.

A message is one frame of msgpack, `[version, kind, fields]`:

    version   1; another one is refused
    kind      name of the message in small letters: "features", "track" ...
    fields    map from each field's name to its value, see `catstream.messages`
    a box     [x, y, w, h]
    an array  {"dtype": "<f4" | "<f8", "shape": [...], "data": bytes, row by row, little-endian}

Every size has a limit before memory is taken for it; then types, shapes, dtypes and ranges are
checked, and every number is finite. A field that this version does not know is ignored.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgpack
import msgspec
import numpy as np

from catstream.box import Box
from catstream.errors import ProtocolError
from catstream.messages import (
    Answer,
    Command,
    DetectorState,
    End,
    Features,
    Health,
    Model,
    Motion,
    Position,
    Preview,
    Run,
    Sample,
    Stored,
    Summary,
    Track,
)

__all__ = ["KINDS", "VERSION", "check", "decode", "decode_json", "encode", "encode_json", "opening"]

#: Of the envelope and of what the fields mean.
VERSION = 1

#: Kinds of message, by their name on the wire.
KINDS: dict[str, type] = {
    kind.__name__.lower(): kind
    for kind in (Answer, Command, End, Features, Health, Model, Position, Preview, Run, Sample, Stored, Track)
}

_F32, _F64 = np.dtype("<f4"), np.dtype("<f8")

#: Of each array: its dtype and shape. A letter stands for the same length throughout a message.
_ARRAYS: dict[type, dict[str, tuple[np.dtype, tuple[int | str, ...]]]] = {
    Features: {
        "rows": (_F32, ("k", "d")),
        "labels": (_F32, ("k",)),
        "weights": (_F32, ("k",)),
        "extents": (_F32, ("s", "d")),
        "fits": (_F32, ("s",)),
    },
    Summary: {"rows": (_F32, ("r", "d")), "mean": (_F32, ("d",))},
    Sample: {"centres": (_F64, ("m", 2))},
    DetectorState: {"centre": (_F64, (5, 4)), "balance": (_F64, (6,))},
    Motion: {"process": (_F64, (4, 4)), "observation": (_F64, (2, 2))},
    Model: {"weights": (_F32, ("d",)), "extent": (_F32, ("d",))},
}

#: Names of the fields: to ask a class for them takes longer than to check them.
_NAMES = {kind: tuple(field.name for field in dataclasses.fields(kind)) for kind in (*KINDS.values(), *_ARRAYS)}

#: Arrays in which NaN has a meaning.
_MAY_BE_NAN = {(Sample, "centres")}

_LONGEST_TEXT = 4096  # bytes
_LONGEST_LIST = 256  # entries of a list or map: levels of a tree, counters
_LONGEST_PICTURE = 1 << 19  # bytes
_JPEG = b"\xff\xd8\xff"  # what every one begins with
_LARGEST_INTEGER = 2**53  # so that a reader in any language holds it exactly


def encode(message: Any) -> bytes:
    """A message as bytes.

    Raises
    ------
    ProtocolError
        Where it is not what its kind promises: it would be refused on arrival.
    """
    check(message)
    return _ENCODER.encode((VERSION, type(message).__name__.lower(), message))


def decode(data: bytes | memoryview, *kinds: type) -> Any:
    """The message in `data`, one of `kinds`. Arrays come read-only.

    Raises
    ------
    ProtocolError
        Where it is anything else; says what was expected and what came.
    """
    expected = " or ".join(sorted(kind.__name__.lower() for kind in kinds))
    try:
        envelope = msgpack.unpackb(
            data,
            object_pairs_hook=_unique,
            max_bin_len=len(data),
            max_str_len=_LONGEST_TEXT,
            max_array_len=_LONGEST_LIST,
            max_map_len=_LONGEST_LIST,
            max_ext_len=0,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise ProtocolError(
            f"expected {expected}, got {len(data)} bytes that are not its msgpack: {error}", "msgpack"
        ) from None
    if not isinstance(envelope, list) or len(envelope) != 3:
        raise ProtocolError(
            f"expected {expected} as [version, kind, fields], got something else in msgpack", "envelope"
        )
    version, name, fields = envelope
    if version != VERSION:
        raise ProtocolError(
            f"expected version {VERSION} of the protocol, got {_brief(version)}: run the same catstream", "version"
        )
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind not in kinds:
        raise ProtocolError(f"expected {expected}, got {_brief(name)}", "kind")
    try:
        message: Any = msgspec.convert(fields, kind, dec_hook=_array)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"{name}: {error}", "type") from None
    check(message)
    return message


def opening(kind: type) -> bytes:
    """What the bytes of every message of a kind begin with."""
    return _ENCODER.encode((VERSION, kind.__name__.lower(), None))[:-1]  # nil is one byte


def encode_json(message: Any) -> bytes:
    """A message without arrays as a JSON object of its fields, for recordings.

    Raises
    ------
    ProtocolError
        If a field is outside of its limits.
    """
    check(message)
    return msgspec.json.encode(message)


def decode_json(data: bytes, kind: type) -> Any:
    """The message that `encode_json` wrote.

    Raises
    ------
    ProtocolError
        If it is not JSON, or not the fields of a message of this kind within their limits.
    """
    try:
        message: Any = msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise ProtocolError(
            f"expected {kind.__name__.lower()} in JSON, got {len(data)} bytes: {error}", "json"
        ) from None
    check(message)
    return message


def _brief(value: Any) -> str:
    """A value for a person to read; lists may be nested deeper than Python can print."""
    return f"{value!r:.40}" if isinstance(value, str | int) else f"a {type(value).__name__}"


def _plain(value: Any) -> Any:
    """How an array travels."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {"dtype": array.dtype.str, "shape": array.shape, "data": array.data.cast("B") if array.size else b""}
    raise TypeError(f"{type(value).__name__} does not travel")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    dtype: str
    shape: list[int]
    data: bytes


def _array(_: type, value: Any) -> np.ndarray:
    """The array that `_plain` described."""
    plain = msgspec.convert(value, _Array)
    if plain.dtype not in ("<f4", "<f8") or not 1 <= len(plain.shape) <= 2 or min(plain.shape) < 0:
        raise ValueError(f"an array of {plain.dtype:.20} and shape {plain.shape} does not travel")
    dtype = np.dtype(plain.dtype)
    if math.prod(plain.shape) * dtype.itemsize != len(plain.data):
        raise ValueError(f"{len(plain.data)} bytes are not an array of {plain.dtype} and shape {plain.shape}")
    return np.frombuffer(plain.data, dtype).reshape(plain.shape)


def _unique(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a name comes twice in a map")
    return fields


def check(message: Any) -> None:
    """Raise ProtocolError unless every field of a message keeps its promise."""
    kind, lengths = type(message), dict[str, int]()
    for name in _NAMES[kind]:
        value = getattr(message, name)
        if isinstance(value, np.ndarray):
            _check_array(value, kind, name, lengths)
        elif type(value) in _NAMES:
            check(value)
        else:
            _check_numbers(value, kind, name)
    if isinstance(message, Features):
        shares = np.concatenate([message.labels, message.fits])
        if not ((shares >= 0).all() and (shares <= 1).all() and (message.weights > 0).all()):
            raise ProtocolError("features: expected labels and fits from 0 to 1 and weights above 0", "range")
    if isinstance(message, Sample):
        d = len(message.object.mean)
        trees = (message.background, message.loss, message.extent)
        widths = [len(tree.mean) if tree is not None else d + 2 for tree in trees]
        if widths != [d, d + 2, d + 2]:
            raise ProtocolError(f"sample: expected trees of d, d, d + 2 and d + 2 columns, got {[d, *widths]}", "width")
    if isinstance(message, Preview):
        if not (message.jpeg.startswith(_JPEG) and len(message.jpeg) <= _LONGEST_PICTURE):
            raise ProtocolError(
                f"preview jpeg: expected a JPEG of at most {_LONGEST_PICTURE} bytes, got {len(message.jpeg)} "
                f"that begin with {message.jpeg[:3]!r}"
            )
        if not (message.width and message.height):
            raise ProtocolError(f"preview: expected sides above 0, got {message.width} x {message.height}")
    if isinstance(message, Command) and (message.box is not None) != (message.verb == "set-box"):
        raise ProtocolError(f"command: expected a box with set-box and with nothing else, got {message.verb!r}")


def _where(kind: type, name: str) -> str:
    return f"{kind.__name__.lower()} {name}"


def _check_array(array: np.ndarray, kind: type, name: str, lengths: dict[str, int]) -> None:
    dtype, shape = _ARRAYS[kind][name]
    if array.ndim == len(shape):
        expected = tuple(
            lengths.setdefault(side, length) if isinstance(side, str) else side
            for side, length in zip(shape, array.shape, strict=True)
        )
    if array.ndim != len(shape) or array.shape != expected or array.dtype != dtype:
        letters = ", ".join(map(str, shape))
        raise ProtocolError(
            f"{_where(kind, name)}: expected {dtype} ({letters}), got {array.dtype} {array.shape} with {lengths}",
            "dtype" if array.dtype != dtype else "shape",
        )
    if (kind, name) not in _MAY_BE_NAN and not np.isfinite(array).all():
        raise ProtocolError(f"{_where(kind, name)}: holds numbers that are not finite", "finite")


def _check_numbers(value: Any, kind: type, name: str) -> None:
    if isinstance(value, Box) and not (value.w > 0 and value.h > 0):
        raise ProtocolError(f"{_where(kind, name)}: expected a width and a height above 0, got {value}", "range")
    numbers = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,)
    for number in numbers:
        if isinstance(number, float) and not math.isfinite(number):
            raise ProtocolError(f"{_where(kind, name)}: expected a finite number, got {number}", "finite")
        if isinstance(number, int) and not 0 <= number <= _LARGEST_INTEGER:
            raise ProtocolError(f"{_where(kind, name)}: expected a whole number from 0 to 2**53, got {number}", "range")
