"""The table of destinations of tracks.

A sink receives each frame during a run: `catstream track --write DEST`, `catstream sink DEST`. A new sink is a row
here, a class in its own module, and a line in docs/how-to/sinks.md. The formats to which a log is converted afterwards
are in `catstream.output.exports`.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.metadata import version
from math import nan
from pathlib import Path
from typing import Any, NamedTuple, Self, cast

import msgspec

from catstream.base.addresses import is_live, without_password
from catstream.base.box import Box
from catstream.base.files import check_file, check_unlocked
from catstream.client.address import Address
from catstream.errors import VideoError
from catstream.output.events import WHEN, Point
from catstream.video.images import IMAGES
from catstream.video.source import VIDEOS
from catstream.wire.messages import Track

#: The destination for standard output.
STDOUT = "-"

#: Version of the format of a log.
FORMAT = 1


class TrackedFrame(NamedTuple):
    """One or more tracks of a frame; a subscriber passes on each track separately.

    seconds  processing time of the frame, NaN if unknown
    """

    tracks: Sequence[Track]
    seconds: float = nan

    @property
    def number(self) -> int:
        return self.tracks[0].frame


@dataclass(frozen=True, slots=True)
class Header:
    """The run of a log: its first line in NDJSON, or the table `header` in a database.

    catstream  version of the format of the log
    frame      -1, for programs that read a frame number in each line
    source     path or address of the source, without a password; empty if another program runs the pipeline
    size       width and height of a frame, pixels; None if unknown
    rate       frames per second of the source; None if unknown
    frames     number of frames that the run tracks; None if unknown, or if the source is live
    start      number in the source of the first tracked frame
    stride     the run tracks every `stride`-th frame of the source
    version    version of the program
    settings   NAME=VALUE of each setting that differs from its default
    boxes      initial box of each object that the run started with, by name
    gap        in a header within the log, number of missing frames before it, for example because the disk was full
    """

    catstream: int = FORMAT
    frame: int = -1
    source: str = ""
    size: tuple[int, int] | None = None
    rate: float | None = None
    frames: int | None = None
    start: int = 0
    stride: int = 1
    version: str = field(default_factory=partial(version, "catstream"))
    settings: tuple[str, ...] = ()
    boxes: dict[str, Box] = field(default_factory=dict)
    gap: int = 0

    def to_json(self) -> str:
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str | bytes) -> Self | None:
        """Read the header of a log; None if the text is not a header, VideoError if it is from another version."""
        try:
            written = json.loads(text)["catstream"]
        except (ValueError, TypeError, KeyError):
            return None
        if written != FORMAT:
            raise VideoError(
                f"the log has version {written} of its format, expected {FORMAT}: read it with the catstream that "
                "wrote it"
            )
        try:
            return msgspec.json.decode(text, type=cls)
        except msgspec.ValidationError as error:
            raise VideoError(f"the header of the log is invalid ({error})") from None


class Rotation(NamedTuple):
    """When a log is rotated: at the first frame of a new period (in UTC), or above a size."""

    seconds: float
    bytes: float


@dataclass(frozen=True, slots=True)
class SinkOptions:
    """Options of the destinations; `catstream.output.options` has their table.

    zone         corners of each zone, a polygon in pixels of the frame, by name
    when         kinds of events that are sent, see `catstream.output.events.WHEN`
    rate         maximum number of states of each object per second
    picture      whether each event has the newest picture of the pipeline
    secret_file  file of the key that signs events; None for no signatures
    megabytes    maximum size of a folder
    rotate       when the logs of a live source are rotated; None for never
    keep         maximum number of rotated logs, 0 for no limit
    """

    zone: dict[str, tuple[Point, ...]] = field(default_factory=dict)
    when: dict[str, float] = field(default_factory=WHEN.copy)
    rate: float = 1.0
    picture: bool = False
    secret_file: Path | None = None
    megabytes: float = 1000.0
    rotate: Rotation | None = None
    keep: int = 0


@dataclass(frozen=True, slots=True)
class Origin:
    """The run whose tracks a sink writes.

    header    header of its log
    address   address of the running pipeline, for a sink that also receives pictures
    options   options of the destinations
    attached  whether another program runs the pipeline, so its source cannot be read a second time
    last      last frame of a log that is continued; None for a new file
    size      number of bytes up to the end of that frame
    gap       number of frames that were missed while the sink could not be opened
    """

    header: Header = field(default_factory=Header)
    address: Address = field(default_factory=Address)
    options: SinkOptions = field(default_factory=SinkOptions)
    attached: bool = False
    last: TrackedFrame | None = None
    size: int = 0
    gap: int = 0


class Sink(ABC):
    """Writes frames in their order; created as `Class(dest, origin)`.

    The class may have a function `check(dest, options)`, which raises VideoError before the run if the address or an
    option is invalid.

    missed  number of frames or messages that were dropped because the destination was locked, slow or unreachable
    """

    missed = 0

    @abstractmethod
    def write(self, frame: TrackedFrame) -> None:
        """Add a frame; raise VideoError if this fails."""

    def idle(self) -> object:  # noqa: B027  # optional
        """Do periodic work; called every few seconds while no frame arrives."""

    def end(self) -> object:  # noqa: B027
        """Send the last events without waiting for their delivery; called before any sink is closed."""

    @abstractmethod
    def close(self) -> None:
        """Complete the output; raise VideoError if this fails."""


class Row(NamedTuple):
    """A row of the table: the class or function of a sink, as module.Name, and a line of the help."""

    target: str
    meaning: str

    def load(self) -> Any:
        """Import the class or function."""
        module, _, name = self.target.rpartition(".")
        return getattr(import_module(f"catstream.output.{module}"), name)


#: Sinks by the suffix of a file, the scheme of an address such as "mqtt://", "/" for a folder, or "-".
SINKS = {
    ".ndjson": Row("track_log.NdjsonSink", "the log: one JSON object per line, after a header"),
    STDOUT: Row("track_log.StdoutSink", "the same, without the header, on standard output"),
    ".csv": Row("track_log.CsvSink", "a row for each object and frame: frame, seconds, state, box, score ..."),
    ".sqlite": Row("database.SqliteSink", "the table tracks of a database, which others read meanwhile"),
    ".mp4": Row("video_sink.open_video", "the frames with their boxes drawn in"),
    "mqtt://": Row("mqtt_sink.MqttSink", "HOST/TOPIC: events and states of objects, for a broker"),
    "mqtts://": Row("mqtt_sink.MqttSink", "the same with TLS"),
    "http://": Row("webhook.Webhook", "HOST/PATH: each event as JSON, by POST"),
    "https://": Row("webhook.Webhook", "the same with TLS"),
    "/": Row("events_folder.EventsFolder", "a folder, DIR/: each event in events.ndjson, and its picture as JPEG"),
}


def kind_of(dest: str) -> str:
    """Return the key for `SINKS` of a destination, valid or not.

    >>> kind_of("out/walk.csv"), kind_of("mqtt://host/yard"), kind_of("events/"), kind_of("-")
    ('.csv', 'mqtt://', '/', '-')
    """
    scheme, mark, _ = dest.partition("://")
    if mark or dest == STDOUT:
        return scheme + mark
    return "/" if dest.endswith("/") else Path(dest).suffix


def sink_of(dest: str) -> Row:
    """Return the row of a destination; raises VideoError if it is unknown."""
    row = SINKS.get(kind_of(dest))
    if row is None:
        raise VideoError(
            f"{redacted(dest)} is not a destination of tracks: pass a file or address with one of {', '.join(SINKS)}, "
            "where - is standard output, and / ends the name of a folder; for other formats use catstream export"
        )
    return row


def is_file(dest: str) -> bool:
    """Return True if a destination is a file: not standard output, an address or a folder."""
    return dest != STDOUT and "://" not in dest and not dest.endswith("/")


def check_result(path: Path, *, overwrite: bool, source: str = "", made: Path | None = None) -> None:
    """Raise VideoError if a file belongs to the source, is locked, or fails `catstream.base.files.check_file`."""
    if source and path.exists() and Path(source).exists() and path.samefile(source):
        raise VideoError(f"{path} is the source, which would be lost: use another name or folder")
    if Path(source).is_dir() and path.exists() and path.suffix in VIDEOS | IMAGES and Path(source) in path.parents:
        raise VideoError(f"{path} is in the folder of the source, and may be its video: use another name or folder")
    check_unlocked(path, VideoError)
    check_file(path, overwrite=overwrite, made=made, kind=VideoError, may_wait=is_live(source))


def check_sink(dest: str, options: SinkOptions, source: str = "") -> None:
    """Raise VideoError if a destination is unknown, its address or an option is invalid, or `source` is unsuitable."""
    sink = sink_of(dest).load()
    if is_file(dest) and dest.endswith(".mp4") and is_live(source):
        raise VideoError(f"a video needs its frames once more, but {source} is live: omit the video")
    if hasattr(sink, "check"):
        sink.check(dest, options)


def redacted(dest: str) -> str:
    """Return a destination for messages: an address without its password, and only the host of a webhook.

    >>> redacted("mqtt://me:secret@10.0.0.7/yard"), redacted("https://example.com/hooks/T0/B0/secret")
    ('mqtt://10.0.0.7/yard', 'https://example.com/...')
    """
    if is_file(dest):
        return dest
    address = without_password(dest)
    scheme, _, rest = address.partition("://")
    return f"{scheme}://{rest.partition('/')[0]}/..." if scheme in ("http", "https") else address


def open_sink(dest: str, origin: Origin) -> Sink:
    """Open the sink of a destination; raises VideoError if this fails."""
    return cast(Sink, sink_of(dest).load()(dest, origin))
