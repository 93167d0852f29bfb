"""The container of a recording: an MCAP file (https://mcap.dev/spec) with one message in each chunk.

    magic, header, a schema and a channel for each topic
    for each message: an uncompressed chunk with its CRC-32, and the message index of the chunk
    end of data, summary with an index of all chunks, footer, magic

A chunk and its message index are called an entry here. An entry is appended with one write, so that a process that is
killed leaves at most one torn entry, at the end of the file. In MCAP a CRC covers a chunk: with one message in each,
damage costs no other message. The last line is written when the file is closed. Other programs need it, catstream does
not.
"""

from __future__ import annotations

import mmap
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from io import BytesIO
from typing import BinaryIO, Protocol

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

__all__ = ["MAGIC", "Entry", "Index", "Topic", "end_of_data", "entries", "entry_at", "opening", "pack", "summary"]

#: The first and the last bytes of the file.
MAGIC = b"\x89MCAP0\r\n"

_LARGEST = 512 << 20  # bytes of a chunk; no message is as large
_RECORD = struct.Struct("<BQ")  # opcode and length, in front of each record
_FACTS = struct.Struct("<HIQ")  # channel, sequence and time: the first fields of a message
_BLOCK = 1 << 20  # bytes of the summary in memory
# An entry begins with the opcode and the fixed zeros of a chunk and of its message; the fields of the message follow.
_START = re.compile(rb"\x06(?=.{4}\0{4}.{28}\0{4}.{4}\0{4}\x05.{4}\0{4})", re.DOTALL)
_FACTS_PLACE = 58


class _Record(Protocol):
    def write(self, stream: RecordBuilder) -> None: ...


@dataclass(frozen=True, slots=True)
class Topic:
    """Messages of one kind.

    name         of the topic
    encoding     of its messages: "json" or "msgpack"
    description  of its messages, for a person; empty for JSON
    """

    name: str
    encoding: str
    description: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """A message in the file.

    place     of the entry: bytes from the start of the file
    size      of the entry in bytes
    channel   number of its topic, from 1
    sequence  of the message, modulo 2^32
    time      of recording, in nanoseconds since 1970
    data      the message as bytes
    """

    place: int
    size: int
    channel: int
    sequence: int
    time: int
    data: bytes


class Index:
    """Place, size, channel and time of all entries; 22 bytes of memory for each."""

    _ROW = struct.Struct("<QIHQ")

    def __init__(self) -> None:
        self._rows = bytearray()

    def add(self, place: int, size: int, channel: int, time: int) -> None:
        """Add an entry that follows all others."""
        self._rows += self._ROW.pack(place, size, channel, time)

    def __len__(self) -> int:
        return len(self._rows) // self._ROW.size

    def __iter__(self) -> Iterator[tuple[int, int, int, int]]:
        yield from self._ROW.iter_unpack(self._rows)


def opening(topics: Sequence[Topic]) -> bytes:
    """The bytes before the first entry."""
    header = Header("catstream", f"catstream {version('catstream')}")
    return MAGIC + _bytes([header, *_schemas(topics), *_channels(topics)])


def pack(channel: int, sequence: int, time: int, data: bytes) -> bytes:
    """An entry as bytes."""
    message = _bytes([Message(channel, time, data, time, sequence & 0xFFFFFFFF)])
    chunk = Chunk("", message, time, time, zlib.crc32(message), len(message))
    return _bytes([chunk, MessageIndex(channel, [(time, 0)])])


def entries(file: BinaryIO) -> Iterator[Entry]:
    """All whole entries of a file, in order."""
    place = _next_whole(file, len(MAGIC))
    while place is not None:
        entry = entry_at(file, place)
        if entry is not None:
            yield entry
        place = entry.place + entry.size if entry is not None else _next_whole(file, place + 1)


def entry_at(file: BinaryIO, place: int) -> Entry | None:
    """The entry at a place; None if the bytes there are not exactly those that `pack` makes of a message."""
    file.seek(place)
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        return None
    opcode, length = _RECORD.unpack(head)
    if opcode != Opcode.CHUNK or length > _LARGEST:
        return None
    data = head + file.read(length + _INDEX_SIZE)
    if len(data) < _EMPTY_SIZE:
        return None
    channel, sequence, time = _FACTS.unpack_from(data, _FACTS_PLACE)
    message = data[_EMPTY_SIZE - _INDEX_SIZE : -_INDEX_SIZE]
    if data != pack(channel, sequence, time, message):
        return None
    return Entry(place, len(data), channel, sequence, time, message)


def end_of_data(file: BinaryIO) -> int | None:
    """The place after the last entry of a file, read from its footer; None if the file was not closed."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _FOOTER_SIZE - len(MAGIC)))
    footer = file.read()
    if not footer.endswith(MAGIC) or footer[: _RECORD.size] != _RECORD.pack(Opcode.FOOTER, _FOOTER_SIZE - _RECORD.size):
        return None
    place: int = Footer.read(ReadDataStream(BytesIO(footer[_RECORD.size :]))).summary_start - len(_END_OF_DATA)
    return place if 0 <= place < size else None


def summary(topics: Sequence[Topic], index: Index, place: int) -> Iterator[bytes]:
    """The bytes after the last entry, which ends at `place`, in blocks."""
    yield _END_OF_DATA
    start = place = place + len(_END_OF_DATA)
    check, offsets = 0, []
    groups: dict[int, Iterable[_Record]] = {
        Opcode.SCHEMA: _schemas(topics),
        Opcode.CHANNEL: _channels(topics),
        Opcode.STATISTICS: [_statistics(topics, index)],
        Opcode.CHUNK_INDEX: _chunk_indexes(index),
    }
    for opcode, records in groups.items():
        begin = place
        for block in _blocks(records):
            yield block
            place, check = place + len(block), zlib.crc32(block, check)
        offsets.append(SummaryOffset(opcode, begin, place - begin))
    block = _bytes(offsets)
    yield block
    footer = Footer(start, place, 0)
    check = zlib.crc32(_bytes([footer])[:-4], zlib.crc32(block, check))  # the CRC covers the footer up to itself
    yield _bytes([Footer(start, place, check)]) + MAGIC


def _next_whole(file: BinaryIO, start: int) -> int | None:
    """The place of the first whole entry from `start` on; None if there is none."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in _START.finditer(data, start):
            if entry_at(file, found.start()) is not None:
                return found.start()
    return None


def _bytes(records: Iterable[_Record]) -> bytes:
    return b"".join(_blocks(records))


def _blocks(records: Iterable[_Record]) -> Iterator[bytes]:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
        if builder.count > _BLOCK:
            yield builder.end()
    yield builder.end()


def _schemas(topics: Sequence[Topic]) -> list[Schema]:
    described = [(number, topic) for number, topic in enumerate(topics, 1) if topic.description]
    return [Schema(number, topic.description.encode(), "text", topic.name) for number, topic in described]


def _channels(topics: Sequence[Topic]) -> list[Channel]:
    return [
        Channel(number, topic.name, topic.encoding, {}, number if topic.description else 0)  # 0: no schema
        for number, topic in enumerate(topics, 1)
    ]


def _statistics(topics: Sequence[Topic], index: Index) -> Statistics:
    counts = Counter(channel for _, _, channel, _ in index)
    return Statistics(
        attachment_count=0,
        channel_count=len(topics),
        channel_message_counts=dict(counts),
        chunk_count=len(index),
        message_count=len(index),
        message_end_time=max((time for *_, time in index), default=0),
        message_start_time=min((time for *_, time in index), default=0),
        metadata_count=0,
        schema_count=len(_schemas(topics)),
    )


def _chunk_indexes(index: Index) -> Iterator[ChunkIndex]:
    head = _EMPTY_SIZE - len(_bytes([Message(0, 0, b"", 0, 0)])) - _INDEX_SIZE  # of a chunk, before its records
    for place, size, channel, time in index:
        length = size - _INDEX_SIZE
        yield ChunkIndex(
            chunk_length=length,
            chunk_start_offset=place,
            compression="",
            compressed_size=length - head,
            message_end_time=time,
            message_index_length=_INDEX_SIZE,
            message_index_offsets={channel: place + length},
            message_start_time=time,
            uncompressed_size=length - head,
        )


_EMPTY_SIZE = len(pack(0, 0, 0, b""))
_INDEX_SIZE = len(_bytes([MessageIndex(0, [(0, 0)])]))
_FOOTER_SIZE = len(_bytes([Footer(0, 0, 0)]))
_END_OF_DATA = _bytes([DataEnd(0)])
