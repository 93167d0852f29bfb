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

The bytes are decoded straight into the fields of their kind: what is not one of them is skipped, and takes no memory.
A sender decodes what it sends, too, so that nothing leaves it that would be rejected on arrival.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import field
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from catstream.errors import ProtocolError
from catstream.messages.kinds import Position
from catstream.messages.schema import Integer, Text, check_message
from catstream.wire.channels import CHANNELS, REGISTRY

Message = TypeVar("Message")

#: Version of the envelope and of the meaning of the fields.
VERSION = 4

#: Kinds of message, by their name on the wire: those of the channels, and the reply on an acknowledged one.
KINDS: dict[str, type] = {
    kind.__name__.lower(): kind for channel in (*CHANNELS.values(), REGISTRY) for kind in channel.messages
} | {"position": Position}

#: What is wrong with bytes: msgspec raises no other error for them.
_ERRORS = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class Topic(NamedTuple):
    """Kind and object of a message."""

    kind: str
    object: str


class _Envelope(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    version: int
    kind: Text
    object: Text
    run: Text
    fields: msgspec.Raw


def encode(message: object, run: str = "") -> bytes:
    """A message of a run as bytes; ProtocolError if it breaks its schema."""
    check_message(message)
    kind = type(message)
    data = _ENCODER.encode((VERSION, kind.__name__.lower(), getattr(message, "object", ""), run, message))
    _fields_in(_opened(data), kind)
    return data


def decode(data: bytes | memoryview, *kinds: type[Message]) -> Message:
    """The message in `data`, one of `kinds`, with read-only arrays; ProtocolError if it is anything else."""
    return decode_with_run(data, *kinds)[0]


def decode_with_run(data: bytes | memoryview, *kinds: type[Message]) -> tuple[Message, str]:
    """The same, and the run that the message is from."""
    envelope = _opened(data)
    if (kind := KINDS.get(envelope.kind)) not in kinds:
        expected = " or ".join(sorted(kind.__name__.lower() for kind in kinds))
        raise ProtocolError(f"expected {expected}, got {envelope.kind!r:.40}")
    message: Message = _fields_in(envelope, kind)
    if type(message) is not kind:
        try:
            message = msgspec.convert(message, kind, from_attributes=True, dec_hook=_array)
        except msgspec.ValidationError as error:
            raise ProtocolError(f"{envelope.kind}: {error}") from None
        check_message(message)
    if envelope.object != getattr(message, "object", ""):
        raise ProtocolError(f"{envelope.kind}: the envelope names another object, {envelope.object!r:.40}")
    return message, envelope.run


def opening(kind: type, about: str | None = None) -> bytes:
    """The bytes that every message of a kind begins with; of those about one object, if a name is given."""
    names = (kind.__name__.lower(),) if about is None else (kind.__name__.lower(), about)
    return _ENCODER.encode((VERSION, *names, *[None] * (4 - len(names))))[: -(4 - len(names))]  # nil is one byte


def topic_of(data: bytes | memoryview) -> Topic:
    """The topic of a message; of no kind if it is not a message.

    >>> from catstream.messages.kinds import End
    >>> topic_of(encode(End(1, "over")))
    Topic(kind='end', object='')
    """
    try:
        envelope = _opened(data)
    except ProtocolError:
        return Topic("", "")
    return Topic(envelope.kind, envelope.object)


def decode_json(data: bytes, kind: type[Message]) -> Message:
    """A message without arrays, from a JSON object of its fields; ProtocolError if it is anything else."""
    try:
        return msgspec.json.decode(data, type=kind)
    except _ERRORS as error:
        raise ProtocolError(f"expected {kind.__name__.lower()} in JSON, got {len(data)} bytes: {error}") from None


def _opened(data: bytes | memoryview) -> _Envelope:
    try:
        envelope = _OPENER.decode(data)
    except _ERRORS as error:
        raise ProtocolError(f"expected [version, kind, object, run, fields] in msgpack: {error}") from None
    if envelope.version != VERSION:
        raise ProtocolError(
            f"expected version {VERSION} of the protocol, got {envelope.version}: run the same catstream"
        )
    return envelope


def _fields_in(envelope: _Envelope, kind: type) -> Any:
    """The fields of a message of this kind, in the form that `_form` gives it."""
    try:
        return _decoder(kind).decode(envelope.fields)
    except _ERRORS as error:
        raise ProtocolError(f"{envelope.kind}: {error}") from None


@cache
def _decoder(kind: type) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(_form(kind))


def _form(hint: Any) -> Any:
    """The type into which bytes are decoded for a kind of message, or for a field of it.

    It has an `_Array` for each array: msgspec would take any value for an array, however deeply nested.
    """
    if hint is np.ndarray:
        return _Array
    if dataclasses.is_dataclass(hint):
        hints = get_type_hints(hint, include_extras=True)
        forms = {name: _form(each) for name, each in hints.items()}
        if forms == hints:
            return hint
        return dataclasses.make_dataclass(
            hint.__name__,  # type: ignore[union-attr]
            [
                (each.name, forms[each.name], field(default=each.default, default_factory=each.default_factory))
                for each in dataclasses.fields(hint)
            ],
        )
    if (origin := get_origin(hint)) is Annotated:
        return Annotated[(_form(hint.__origin__), *hint.__metadata__)]
    if origin in (dict, Union, UnionType):
        return (dict if origin is dict else Union)[tuple(map(_form, get_args(hint)))]
    return hint


def _plain(value: object) -> dict[str, object]:
    """An array as the map that is sent."""
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {"dtype": array.dtype.str, "shape": array.shape, "data": array.data.cast("B") if array.size else b""}
    raise TypeError(f"{type(value).__name__} cannot be sent")


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    dtype: Literal["<f4", "<f8"]
    shape: Annotated[tuple[Integer, ...], msgspec.Meta(min_length=1, max_length=2)]
    data: memoryview


def _array(_: type, value: Any) -> np.ndarray:
    """The array that `_plain` converted."""
    if math.prod(value.shape) * np.dtype(value.dtype).itemsize != len(value.data):
        raise ValueError(f"{len(value.data)} bytes are not an array of {value.dtype} and shape {value.shape}")
    return np.frombuffer(bytes(value.data), value.dtype).reshape(value.shape)  # a copy, which begins at a word


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)
_OPENER = msgspec.msgpack.Decoder(_Envelope)
