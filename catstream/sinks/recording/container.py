"""The container of a recording: MCAP files (https://mcap.dev/spec) with one message in each chunk.

The library `mcap` writes them. In MCAP a CRC covers a chunk: with one message in each, damage costs no other message.
The readers of the library stop at the first damaged or torn chunk, so chunks are found here, and parsed by the library.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, BinaryIO, cast

#: The first and the last bytes of a file.
MAGIC = b"\x89MCAP0\r\n"
#: Bytes of the message index behind a chunk of one message: opcode and length, channel, length, and one time and place.
INDEX_SIZE = 9 + 2 + 4 + 16

_CHUNK_OPCODE, _FOOTER_OPCODE = 0x06, 0x02
_LARGEST = 512 << 20  # bytes of a message with its topics; no message is as large
_RECORD_SIZE = 9  # bytes of the opcode and the length, in front of each record
_END_SIZE = _RECORD_SIZE + 4  # of the record between the messages and the index
# Opcode, length, first and last time, size and CRC of the records, length of the compression's name, stored size.
_CHUNK = struct.Struct("<BQQQQIIQ")
# Opcode, length, place of the summary and of its offsets, CRC, and the magic at the end of the file.
_FOOTER = struct.Struct("<BQQQI8s")
# A chunk begins with its opcode and the zeros of small numbers, and then has a schema, a channel or a message.
_START = re.compile(rb"\x06(?=.{4}\0{4}.{20}\0{4}.{4}\0{4}.{4}\0{4}[\x03-\x05].{4}\0{4})", re.DOTALL)


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
    """A message in a file.

    place     of its chunk: bytes from the start of the file
    end       of its chunk
    channel   number of its topic, from 1
    sequence  of the message, modulo 2^32
    time      of recording, in nanoseconds since 1970
    data      the message as bytes
    metadata  of its topic, in the first entry; empty in the others
    """

    place: int
    end: int
    channel: int
    sequence: int
    time: int
    data: bytes
    metadata: dict[str, str]


class Container:
    """A new file to which messages are appended.

    A message is appended with one write, so a process that is killed leaves at most one torn message, at the end.
    `close` adds the index, which other programs need.

    Parameters
    ----------
    topics : numbered from 1 in this order
    metadata : of each topic

    Attributes
    ----------
    messages : number of messages, of which the index keeps about 700 bytes each in memory

    Raises
    ------
    OSError
        From the constructor, if the file exists already or cannot be written; from `add`, if the disk is full or fails:
        the file then ends with the message before, and will have no index.
    """

    def __init__(self, path: Path, topics: Sequence[Topic], metadata: dict[str, str]) -> None:
        from mcap import writer

        self.messages = 0
        self._is_whole, self._pending = True, _Pending()
        self._file = path.open("xb", buffering=0)
        stream = cast("IO[bytes]", self._pending)
        self._writer = writer.Writer(stream, chunk_size=1, compression=writer.CompressionType.NONE)
        self._writer.start("catstream", f"catstream {version('catstream')}")
        for topic in topics:
            described = topic.name, "text", topic.description.encode()
            schema = self._writer.register_schema(*described) if topic.description else 0
            self._writer.register_channel(topic.name, topic.encoding, schema, metadata)

    def add(self, channel: int, sequence: int, time: int, data: bytes) -> None:
        """Append a message. After the return it survives a crash of this process, though not one of the machine."""
        self._writer.add_message(channel, time, data, time, sequence & 0xFFFFFFFF)
        self._append()
        self.messages += 1

    def close(self) -> None:
        """Append the index, if all messages are in the file and the disk has room for it, and close the file."""
        with contextlib.suppress(OSError), self._file:  # without it, `mcap recover` makes it from the messages
            if self._is_whole and not self._file.closed:
                self._writer.finish()
                self._append()

    def _append(self) -> None:
        """Append what the library has written; if that is impossible, remove the part for which the disk had room."""
        start, blocks = self._pending.start, self._pending.take()
        try:
            for block in blocks:
                rest = memoryview(block)
                while rest:
                    rest = rest[self._file.write(rest) :]
        except OSError:
            self._is_whole, self._pending.start = False, start
            self._file.truncate(start)
            self._file.seek(start)
            raise


class _Pending:
    """A stream of what the library has written and the file does not have yet; `start` is its place in the file."""

    def __init__(self) -> None:
        self.start = 0
        self._blocks: list[bytes] = []

    def write(self, data: bytes) -> None:
        self._blocks.append(data)

    def tell(self) -> int:
        return self.start + sum(map(len, self._blocks))

    def take(self) -> list[bytes]:
        """Return the blocks; the next one follows them in the file."""
        self.start, taken, self._blocks = self.tell(), self._blocks, []
        return taken


def entries(file: BinaryIO) -> Iterator[Entry]:
    """All whole messages of a file, in order."""
    entry = _next_whole(file, len(MAGIC))
    while entry is not None:
        yield entry
        entry = entry_at(file, entry.end + INDEX_SIZE) or _next_whole(file, entry.end)


def entry_at(file: BinaryIO, place: int) -> Entry | None:
    """The message whose chunk is at a place; None if there is no whole chunk with one message."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, Message
    from mcap.stream_reader import breakup_chunk

    file.seek(place)
    head = file.read(_CHUNK.size)
    if len(head) < _CHUNK.size:
        return None
    opcode, length, start, end, size, check, compression, stored = _CHUNK.unpack(head)
    is_single = size == stored == length + _RECORD_SIZE - _CHUNK.size <= _LARGEST
    if opcode != _CHUNK_OPCODE or compression or not is_single:
        return None
    data = file.read(size)
    if len(data) < size or zlib.crc32(data) != check:
        return None
    try:
        *records, message = breakup_chunk(Chunk("", data, end, start, check, size))
    except (McapError, OverflowError, ValueError, struct.error):  # of another program, or forged
        return None
    if not isinstance(message, Message) or any(isinstance(record, Message) for record in records):
        return None
    metadata = next((record.metadata for record in records if isinstance(record, Channel)), {})
    return Entry(
        *(place, place + len(head) + size, message.channel_id, message.sequence, message.log_time),
        *(message.data, metadata),
    )


def end_of_data(file: BinaryIO) -> int | None:
    """The place after the last message of a file, read from its footer; None if the file was not closed."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _FOOTER.size))
    footer = file.read()
    if len(footer) < _FOOTER.size or not footer.endswith(MAGIC):
        return None
    opcode, _, summary, *_ = _FOOTER.unpack(footer)
    place: int = summary - _END_SIZE
    return place if opcode == _FOOTER_OPCODE and place < size else None


def _next_whole(file: BinaryIO, start: int) -> Entry | None:
    """The first whole message from a place on; None if there is none."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in _START.finditer(data, start):
            if (entry := entry_at(file, found.start())) is not None:
                return entry
    return None
