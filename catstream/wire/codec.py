"""Messages to bytes and back. Everything that arrives is checked before it is used.

A message is one frame of msgpack, `[version, kind, object, run, fields]`:

    version   4; another one is rejected
    kind      name of the message in small letters: "features", "track" ...
    object    name of the object that the message is about, "" if it is about none or about all
    run       id of the run that it is from: of one start of one pipeline, kept by processes that are restarted; "" if
              the sender knows none
    fields    map from each field's name to its value, see `catstream.messages.kinds`
    a box     [x, y, w, h]
    an array  {"dtype": "<f4" | "<f8", "shape": [...], "data": bytes, row by row, little-endian}

Version, kind and object are the first bytes of a message, and thus its topic: a subscriber may take one kind of
message, or that of one object.

Every size has a limit before memory is taken for it. Then the message is checked against its
schema (`catstream.messages.checks`). A field that this version does not know is ignored.
"""

from __future__ import annotations

import math
from typing import TypeVar

import msgpack
import msgspec
import numpy as np

from catstream.errors import ProtocolError
from catstream.messages.checks import check_message
from catstream.messages.kinds import Position
from catstream.messages.schema import LONGEST_LIST, LONGEST_TEXT
from catstream.wire.channels import CHANNELS, REGISTRY

Message = TypeVar("Message")

#: Version of the envelope and of the meaning of the fields.
VERSION = 4

_LONGEST_TOPIC = 512  # bytes

#: Kinds of message, by their name on the wire: those of the channels, and the reply on an acknowledged one.
KINDS: dict[str, type] = {
    kind.__name__.lower(): kind
    for channel in (*CHANNELS.values(), REGISTRY)
    for kind in channel.messages
} | {"position": Position}


def encode(message: object, run: str = "") -> bytes:
    """A message of a run as bytes.

    Raises
    ------
    ProtocolError
        If it breaks its schema: it would be rejected on arrival.
    """
    check_message(message)
    return _ENCODER.encode((VERSION, type(message).__name__.lower(), getattr(message, "object", ""), run, message))


def decode(data: bytes | memoryview, *kinds: type[Message]) -> Message:
    """The message in `data`, one of `kinds`. Its arrays are read-only.

    Raises
    ------
    ProtocolError
        If it is anything else; the error has the expected and the received kind.
    """
    return decode_with_run(data, *kinds)[0]


def decode_with_run(data: bytes | memoryview, *kinds: type[Message]) -> tuple[Message, str]:
    """The same, and the run that the message is from."""
    expected = " or ".join(sorted(kind.__name__.lower() for kind in kinds))
    try:
        envelope = msgpack.unpackb(
            data,
            object_pairs_hook=_unique,
            max_bin_len=len(data),
            max_str_len=LONGEST_TEXT,
            max_array_len=LONGEST_LIST,
            max_map_len=LONGEST_LIST,
            max_ext_len=0,
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        raise ProtocolError(
            f"expected {expected}, got {len(data)} bytes that are not its msgpack: {error}", "msgpack"
        ) from None
    if isinstance(envelope, list) and len(envelope) > 1 and (version := envelope[0]) != VERSION:
        raise ProtocolError(
            f"expected version {VERSION} of the protocol, got {_brief(version)}: run the same catstream", "version"
        )
    if not isinstance(envelope, list) or len(envelope) != 5:
        raise ProtocolError(
            f"expected {expected} as [version, kind, object, run, fields], got something else in msgpack", "envelope"
        )
    _, name, about, run, fields = envelope
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind not in kinds:
        raise ProtocolError(f"expected {expected}, got {_brief(name)}", "kind")
    try:
        message: Message = msgspec.convert(fields, kind, dec_hook=_array)
    except msgspec.ValidationError as error:
        raise ProtocolError(f"{name}: {error}", "type") from None
    if about != getattr(message, "object", ""):
        raise ProtocolError(
            f"{name}: expected one object, got {_brief(about)} in the envelope and another one in the fields",
            "envelope",
        )
    if not isinstance(run, str):
        raise ProtocolError(f"{name}: expected the id of a run, got {_brief(run)}", "envelope")
    check_message(message)
    return message, run


def opening(kind: type, about: str | None = None) -> bytes:
    """The bytes that every message of a kind begins with; of those about one object, if a name is given."""
    names = (kind.__name__.lower(),) if about is None else (kind.__name__.lower(), about)
    return _ENCODER.encode((VERSION, *names, *[None] * (4 - len(names))))[: -(4 - len(names))]  # nil is one byte


def topic_of(data: bytes | memoryview) -> bytes:
    """The topic of a message: the bytes before its fields; the first bytes of the data if it is not a message.

    >>> from catstream.messages.kinds import End
    >>> topic_of(encode(End(1, "over"))) == opening(End, "")
    True
    """
    reader = msgpack.Unpacker(max_buffer_size=len(data) + 1, max_str_len=LONGEST_TEXT)
    reader.feed(data[:_LONGEST_TOPIC])
    try:
        reader.read_array_header()
        for _ in range(3):
            reader.skip()
    except (ValueError, msgpack.exceptions.UnpackException):
        return bytes(data[:_LONGEST_TOPIC])
    return bytes(data[: reader.tell()])


def encode_json(message: object) -> bytes:
    """A message without arrays as a JSON object of its fields, for recordings.

    Raises
    ------
    ProtocolError
        If a field is outside of its limits.
    """
    check_message(message)
    return msgspec.json.encode(message)


def decode_json(data: bytes, kind: type[Message]) -> Message:
    """The message that `encode_json` wrote.

    Raises
    ------
    ProtocolError
        If it is not JSON, or not the fields of a message of this kind within their limits.
    """
    try:
        message = msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ProtocolError(
            f"expected {kind.__name__.lower()} in JSON, got {len(data)} bytes: {error}", "json"
        ) from None
    check_message(message)
    return message


def _brief(value: object) -> str:
    """A value for an error message; lists may be nested deeper than Python can print."""
    return f"{value!r:.40}" if isinstance(value, str | int) else f"a {type(value).__name__}"


def _plain(value: object) -> dict[str, object]:
    """An array as the map that is sent."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {"dtype": array.dtype.str, "shape": array.shape, "data": array.data.cast("B") if array.size else b""}
    raise TypeError(f"{type(value).__name__} cannot be sent")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    dtype: str
    shape: list[int]
    data: bytes


def _array(_: type, value: object) -> np.ndarray:
    """The array that `_plain` converted."""
    plain = msgspec.convert(value, _Array)
    if plain.dtype not in ("<f4", "<f8") or not 1 <= len(plain.shape) <= 2 or min(plain.shape) < 0:
        raise ValueError(f"an array of {plain.dtype:.20} and shape {plain.shape} cannot be received")
    dtype = np.dtype(plain.dtype)
    if math.prod(plain.shape) * dtype.itemsize != len(plain.data):
        raise ValueError(f"{len(plain.data)} bytes are not an array of {plain.dtype} and shape {plain.shape}")
    return np.frombuffer(plain.data, dtype).reshape(plain.shape)


def _unique(pairs: list[tuple[object, object]]) -> dict[object, object]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a name is twice in a map")
    return fields
