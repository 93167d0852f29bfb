"""Encodes messages as bytes, and decodes them. Every received message is validated before use.

A message is one frame of msgpack, `[version, kind, object, run, fields]`:

    version   5; other versions are rejected
    kind      name of the message in lower case: "features", "track" ...
    object    name of the object that the message is about, or ""
    run       id of the run: one start of one pipeline. Restarted processes keep it; "" if the sender does not know it
    fields    map from each field's name to its value, see `catstream.wire.messages`
    a box     [x, y, w, h]
    an array  {"dtype": "<f4" | "<f8", "shape": [...], "data": bytes, row by row, little-endian}

Version, kind and object are the first bytes of a message, and thus its topic: a subscriber may select one kind of
message, and one object.

msgpack packs and unpacks the bytes, with limits on the length of every text, list and map and on the total number of
entries. msgspec converts the values to the fields of the kind, and ignores unknown fields. A sender applies the same
checks before it sends.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgpack
import msgspec
import numpy as np

from catstream.errors import ProtocolError
from catstream.wire.channels import CHANNELS, REGISTRY
from catstream.wire.messages import Position
from catstream.wire.schema import LONGEST_LIST, LONGEST_TEXT, Integer, Text, check_message

Message = TypeVar("Message")

#: Version of the envelope and of the fields.
VERSION = 5

#: Kinds of message on all channels, and the reply on an acknowledged one, by their name on the wire.
KINDS: dict[str, type] = {
    kind.__name__.lower(): kind for channel in (*CHANNELS.values(), REGISTRY) for kind in channel.messages
} | {"position": Position}

_MOST_ENTRIES = 1 << 18  # in all lists and maps of a message: at most 25 MB of memory; the schema allows 2**17
_TOPIC_BYTES = 512  # upper limit for version, kind and object
_BYTES = (bytes, memoryview)  # msgspec leaves them as they are; by default it would accept text for bytes


class Topic(NamedTuple):
    """Kind and object of a message."""

    kind: str
    object: str


class _Envelope(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    version: int
    kind: Text
    object: Text
    run: Text
    fields: Any


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    dtype: Literal["<f4", "<f8"]
    shape: Annotated[tuple[Integer, ...], msgspec.Meta(min_length=1, max_length=2)]
    data: memoryview


class _Entries:
    """Counts the entries of the lists and maps of a message while it is unpacked."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self, entries: Any) -> Any:
        self._count += 1 + len(entries)
        if self._count > _MOST_ENTRIES:
            raise ValueError(f"it has more than {_MOST_ENTRIES} entries")
        return entries


def encode(message: object, run: str = "") -> bytes:
    """Encode a message of a run; ProtocolError if it violates its schema."""
    check_message(message)
    kind = type(message)
    values = msgspec.to_builtins(message, builtin_types=_BYTES, enc_hook=_plain)
    _convert(values, kind)
    packed: bytes = msgpack.packb((VERSION, kind.__name__.lower(), getattr(message, "object", ""), run, values))
    return packed


def decode(data: bytes | memoryview, *kinds: type[Message]) -> Message:
    """Decode a message of one of `kinds`, with read-only arrays; ProtocolError if `data` is anything else."""
    return decode_with_run(data, *kinds)[0]


def decode_with_run(data: bytes | memoryview, *kinds: type[Message]) -> tuple[Message, str]:
    """Decode a message as `decode` does; returns the id of its run as well."""
    envelope = _unpack(data)
    if envelope.version != VERSION:
        raise ProtocolError(
            f"expected version {VERSION} of the protocol, got {envelope.version}: run the same catstream"
        )
    if (kind := KINDS.get(envelope.kind)) not in kinds:
        expected = " or ".join(sorted(kind.__name__.lower() for kind in kinds))
        raise ProtocolError(f"expected {expected}, got {envelope.kind!r:.40}")
    message: Message = _convert(envelope.fields, kind)
    check_message(message)
    if envelope.object != getattr(message, "object", ""):
        raise ProtocolError(f"{envelope.kind}: the envelope names another object, {envelope.object!r:.40}")
    return message, envelope.run


def opening(kind: type, about: str | None = None) -> bytes:
    """The first bytes of every message of a kind, or of its messages about one object."""
    names = (kind.__name__.lower(),) if about is None else (kind.__name__.lower(), about)
    packed: bytes = msgpack.packb((VERSION, *names, *[None] * (4 - len(names))))
    return packed[: -(4 - len(names))]  # nil is one byte


def topic_of(data: bytes) -> Topic:
    """The topic in the first bytes of a message; its kind is empty if they are invalid.

    >>> from catstream.wire.messages import End
    >>> topic_of(encode(End(0, "over")))
    Topic(kind='end', object='')
    """
    unpacker = msgpack.Unpacker(max_buffer_size=_TOPIC_BYTES)
    unpacker.feed(data[:_TOPIC_BYTES])
    try:
        unpacker.read_array_header()
        match [unpacker.unpack() for _ in range(3)]:
            case [int(version), str(kind), str(about)] if version == VERSION:
                return Topic(kind, about)
    except (ValueError, msgpack.UnpackException):
        pass
    return Topic("", "")


def decode_json(data: bytes, kind: type[Message]) -> Message:
    """Decode a message without arrays from a JSON object; ProtocolError if `data` is anything else."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ProtocolError(f"expected {kind.__name__.lower()} in JSON, got {len(data)} bytes: {error}") from None


def _unpack(data: bytes | memoryview) -> _Envelope:
    """Unpack a message. msgpack limits the nesting to 1024 levels, and copies each array once."""
    entries = _Entries()
    try:
        values = msgpack.unpackb(
            data,
            list_hook=entries,
            object_hook=entries,
            max_str_len=4 * LONGEST_TEXT,  # bytes of UTF-8
            max_array_len=LONGEST_LIST,
            max_map_len=LONGEST_LIST,
            max_ext_len=0,
        )
        return msgspec.convert(values, _Envelope)
    except ValueError as error:  # the base class of the errors of msgpack and msgspec
        raise ProtocolError(
            f"expected [version, kind, object, run, fields] in msgpack: {str(error) or type(error).__name__}"
        ) from None


def _convert(values: Any, kind: type[Message]) -> Message:
    """Convert values by name to a message of a kind."""
    try:
        return msgspec.convert(values, kind, builtin_types=_BYTES, dec_hook=_array)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"{kind.__name__.lower()}: {error}") from None


def _plain(value: object) -> dict[str, object]:
    """Convert an array to the map that is sent."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {"dtype": array.dtype.str, "shape": array.shape, "data": array.data.cast("B") if array.size else b""}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _array(_: type, value: Any) -> np.ndarray:
    """Convert the map of `_plain` to an array in the same memory."""
    array = msgspec.convert(value, _Array, builtin_types=_BYTES)
    if math.prod(array.shape) * np.dtype(array.dtype).itemsize != len(array.data):
        raise ValueError(f"{len(array.data)} bytes are not an array of {array.dtype} and shape {array.shape}")
    return np.frombuffer(array.data, array.dtype).reshape(array.shape)
