"""THE TABLE of destinations and formats of tracks.

A sink takes each frame while the run goes on: `catstream track --write DEST`, `catstream sink DEST`. An export is made
from a log, an NDJSON or CSV file, afterwards: `catstream export LOG DEST`. A new one is a row here, a class or a
function in a file of its own, and a line in docs/how-to/sinks.md.
"""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.metadata import version
from math import nan
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, cast

import msgspec

from catstream.base.addresses import is_live, without_password
from catstream.base.box import Box
from catstream.base.files import check_file, check_unlocked, remove_parts, writing
from catstream.client.address import Address
from catstream.errors import VideoError, require_extra
from catstream.jobs.job import SinkOptions
from catstream.messages.kinds import Track
from catstream.video.images import IMAGES
from catstream.video.source import VIDEOS

#: Stands for standard output.
STDOUT = "-"

#: Version of the format of a log, in its head.
FORMAT = 1


class TrackedFrame(NamedTuple):
    """The tracks of a frame, at least one; a subscriber receives them one by one, and passes on one at a time.

    seconds  processing time of the frame, NaN if it is not known
    """

    tracks: Sequence[Track]
    seconds: float = nan

    @property
    def number(self) -> int:
        return self.tracks[0].frame


@dataclass(frozen=True, slots=True)
class Head:
    """The first line of an NDJSON log, as JSON, and the table `head` of a database: the run that its tracks are of.

    catstream  version of the format of the log
    frame      -1: a program that reads the number of the frame in each line meets the head before frame 0
    source     path or address of the source, without a password; empty beside a running pipeline
    size       width and height of a frame, pixels; None if unknown
    rate       frames per second of the source; None if unknown
    frames     number of frames that the run tracks; None if unknown, or if the source is live
    start      number in the source of the first tracked frame
    stride     the run tracks every `stride`-th frame of the source
    version    version of the program
    settings   NAME=VALUE of each setting that differs from its default
    boxes      initial box of each object that the run started with, by name
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

    def to_json(self) -> str:
        return msgspec.json.encode(self).decode()

    @classmethod
    def from_json(cls, text: str | bytes) -> Self | None:
        """Read the head of a log; None if the text is none, VideoError if it is that of another version."""
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
            raise VideoError(f"the head of the log is invalid ({error})") from None


@dataclass(frozen=True, slots=True)
class Origin:
    """The run whose tracks a sink writes.

    head      of its log
    address   of the running pipeline, for a sink that receives other messages, too
    options   of the destinations, beside their addresses
    attached  whether another program runs the pipeline: its source is not read a second time
    last      last frame of the file if it is a log that is continued; None for a new file
    size      number of bytes up to the end of that frame
    """

    head: Head = field(default_factory=Head)
    address: Address = field(default_factory=Address)
    options: SinkOptions = field(default_factory=SinkOptions)
    attached: bool = False
    last: TrackedFrame | None = None
    size: int = 0


@dataclass(frozen=True, slots=True)
class About:
    """The parameters of an export.

    name     that of the log, for the files in a folder
    size     width and height of a frame in pixels; None if it is not known
    label    the class of all objects; empty if the name of each is its class
    head     head of the log; an empty one if the log has none
    classes  class -> its number, None for its place in this order; empty for all classes, in the order of the log
    images   files of the images of the source; empty if it is a video
    frames   number of frames of the source; None if unknown
    append   whether to add to an existing data set
    source   path of the source whose images are written, too; empty to write none
    """

    name: str
    size: tuple[int, int] | None = None
    label: str = ""
    head: Head = field(default_factory=Head)
    classes: Mapping[str, int | None] = field(default_factory=dict)
    images: Sequence[Path] = ()
    frames: int | None = None
    append: bool = False
    source: str = ""


class Sink(Protocol):
    """Takes the frames in their order; made as `Class(place, origin)`.

    Its class may have a function `check(place, options)`, which raises VideoError before the run if the address or an
    option is not valid, and a method `idle()`, which is called several times a second while no frame arrives.
    """

    def write(self, frame: TrackedFrame) -> None:
        """Add a frame; raise VideoError if that is not possible."""

    def close(self) -> None:
        """Complete what was written, which remains; raise VideoError if that is not possible."""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the table.

    home         the class of a sink, or the function `export(frames, path, about)`; it may return a note for the user
    meaning      a line of the help
    suffix       of the file of an export; empty for a folder
    sized        whether an export has classes, and needs the size of a frame
    images       whether an export refers to the images of the source
    appends      whether an export can be added to an existing one
    extra        the extra that it needs
    options      fields of `SinkOptions` that a sink uses; any of them is an error if no destination does
    """

    home: str
    meaning: str
    suffix: str = ""
    sized: bool = False
    images: bool = False
    appends: bool = False
    extra: str = ""
    options: tuple[str, ...] = ()

    def load(self) -> Any:
        """Import the class or function; raises MissingExtraError if its extra is not installed."""
        if self.extra:
            require_extra(self.extra)
        module, _, name = self.home.rpartition(".")
        return getattr(import_module(f"catstream.sinks.{module}"), name)


#: Options of the sinks that send events.
_EVENTS = ("zones", "margin", "events", "lost_seconds")

#: The suffix of a file, the scheme of an address such as "mqtt://", or "-" for standard output -> the sink.
SINKS = {
    ".ndjson": Row("track_log.NdjsonSink", "the log: one JSON object per line, after a head"),
    STDOUT: Row("track_log.StdoutSink", "the same, without the head, on standard output"),
    ".csv": Row("track_log.CsvSink", "a row for each object and frame: frame, seconds, state, box, score ..."),
    ".sqlite": Row("database.SqliteSink", "the table tracks of a database, which others read meanwhile"),
    ".mp4": Row("video_sink.open_video", "the frames with their boxes drawn in"),
    "mqtt://": Row(
        "mqtt_sink.MqttSink",
        "HOST/TOPIC: events and states of objects, for a broker",
        options=(*_EVENTS, "picture", "rate"),
    ),
    "mqtts://": Row("mqtt_sink.MqttSink", "the same with TLS", options=(*_EVENTS, "picture", "rate")),
    "folder://": Row(
        "events_folder.EventsFolder",
        "DIR: a picture of each event, as with --events-folder",
        options=(*_EVENTS, "folder", "folder_megabytes"),
    ),
    "http://": Row("webhook.Webhook", "HOST/PATH: each event as JSON, by POST", options=(*_EVENTS, "picture", "key")),
    "https://": Row("webhook.Webhook", "the same with TLS", options=(*_EVENTS, "picture", "key")),
}

#: Name of a format -> the export.
EXPORTS = {
    "mot": Row("exports.write_mot", "MOT text: frame,id,x,y,w,h,score,-1,-1,-1, counted from 1", ".txt"),
    "csv": Row("exports.write_csv", "the CSV file of a run", ".csv"),
    "sqlite": Row("database.write_sqlite", "the table tracks of a database", ".sqlite"),
    "parquet": Row("exports.write_parquet", "the same columns in a column store", ".parquet", extra="parquet"),
    "coco": Row(
        "annotations.write_coco", "COCO, with the tracks and the video as in TAO", ".json", True, True, appends=True
    ),
    "cvat": Row("annotations.write_cvat", "CVAT for video 1.1", ".xml", True, True),
    "yolo": Row(
        "annotations.write_yolo", "a folder: labels of each frame, and data.yaml", "", True, True, appends=True
    ),
    "via": Row("annotations.write_via", "VIA tracks, which movement and napari open", ".via.csv", images=True),
    "dlc": Row("exports.write_dlc", "DeepLabCut: the centre of each object by its name, for movement", ".dlc.csv"),
    "sleap": Row("exports.write_sleap", "SLEAP's analysis: the same centres, for sleap-io", ".sleap.csv"),
    "otb": Row("exports.write_otb", "a folder: boxes, confidence and times of each object, as for OTB", appends=True),
    "got10k": Row("exports.write_got10k", "the same in the layout of GOT-10k", appends=True),
    "vot": Row("exports.write_vot", "the same in the layout of VOT's long-term experiment", appends=True),
}


def sink_of(place: str) -> Row:
    """Return the row of a sink; raises VideoError if there is none for this suffix or scheme."""
    scheme, mark, _ = place.partition("://")
    row = SINKS.get(scheme + mark if mark else place if place == STDOUT else Path(place).suffix)
    if row is None:
        raise VideoError(
            f"{redacted(place)} is not a destination of tracks: pass a file or address with one of {', '.join(SINKS)}, "
            "where - is standard output; for other formats use catstream export"
        )
    return row


def export_of(path: Path, name: str | None) -> Row:
    """Return the row of an export, by its name, or else by the longest suffix; raises VideoError if there is none."""
    rows = [row for row in EXPORTS.values() if row.suffix and path.name.endswith(row.suffix)]
    if name is None and not rows:
        raise VideoError(f"unknown format of {path}: pass --format, one of {', '.join(EXPORTS)}")
    return max(rows, key=lambda row: len(row.suffix)) if name is None else EXPORTS[name]


def is_file(place: str) -> bool:
    """Return whether a destination is a file: not standard output, and no address."""
    return place != STDOUT and "://" not in place


def check_result(path: Path, *, overwrite: bool, source: str = "", made: Path | None = None) -> None:
    """Raise VideoError if a file is of the source, if another process writes it, or as `files.check_file` does."""
    if source and path.exists() and Path(source).exists() and path.samefile(source):
        raise VideoError(f"{path} is the source, which would be lost: use another name or folder")
    if Path(source).is_dir() and path.exists() and path.suffix in VIDEOS | IMAGES and Path(source) in path.parents:
        raise VideoError(f"{path} is in the folder of the source, and may be its video: use another name or folder")
    check_unlocked(path, VideoError)
    check_file(path, overwrite=overwrite, made=made, kind=VideoError)


def check_sink(place: str, options: SinkOptions, source: str = "") -> None:
    """Raise VideoError or MissingExtraError if there is no such destination, or the address or an option is invalid.

    Also if it is the video of a live `source`.
    """
    home = sink_of(place).load()
    if is_file(place) and place.endswith(".mp4") and is_live(source):
        raise VideoError(f"a video needs its frames once more, but {source} is live: omit the video")
    if hasattr(home, "check"):
        home.check(place, options)


def redacted(place: str) -> str:
    """Return a destination as messages name it: an address without its password, of a webhook its host alone.

    >>> redacted("mqtt://me:secret@10.0.0.7/yard"), redacted("https://example.com/hooks/T0/B0/secret")
    ('mqtt://10.0.0.7/yard', 'https://example.com/...')
    """
    if is_file(place):
        return place
    address = without_password(place)
    scheme, _, rest = address.partition("://")
    return f"{scheme}://{rest.partition('/')[0]}/..." if scheme in ("http", "https") else address


def open_sink(place: str, origin: Origin) -> Sink:
    """Open the sink of a destination; raises VideoError or MissingExtraError if that is not possible."""
    return cast(Sink, sink_of(place).load()(place, origin))


def idle(sinks: Iterable[Sink]) -> None:
    """Tell sinks that no frame has arrived for a while."""
    for sink in sinks:
        if hasattr(sink, "idle"):
            sink.idle()


def check_export(path: Path, row: Row, *, overwrite: bool, append: bool, log: Path) -> None:
    """Raise VideoError if an export would replace or extend something, unless `overwrite` or `append` allow that."""
    if append and not row.appends:
        raise VideoError(f"{path} can hold one video only: use another name, or pass --overwrite instead of --append")
    if row.suffix:
        check_result(path, overwrite=overwrite or append, source=str(log))
    elif not (overwrite or append or _is_empty(path)):
        raise VideoError(
            f"the folder {path} is not empty: add to its data set with --append, replace it with --overwrite, or use "
            "another folder"
        )


def _is_empty(folder: Path) -> bool:
    """Return True if a folder has no files but the images of a data set, which may be there before its labels."""
    entries = folder.iterdir() if folder.is_dir() else ()
    return all(entry.name == "images" or entry.name.startswith(".") for entry in entries)


def export(frames: Iterable[TrackedFrame], path: Path, row: Row, about: About) -> str:
    """Make a file from the frames of a log, which gets its name once it is complete, or the files of a folder.

    frames : read more than once by some formats

    Returns what the user should know, mostly nothing. Raises VideoError if the files cannot be written, or if the size
    of a frame is needed and unknown.
    """
    make: Callable[[Iterable[TrackedFrame], Path, About], str | None] = row.load()
    if row.sized and about.size is None:
        raise VideoError(
            f"unknown size of the frames, required for {path}: pass --size WIDTHxHEIGHT, or --size SOURCE with the "
            "video or folder that was tracked"
        )
    remove_parts(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    with writing(path, VideoError):
        try:
            if row.suffix and about.append and path.exists():
                shutil.copyfile(path, part)
            note = make(frames, part if row.suffix else path, about)
            if row.suffix:
                part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    return note or ""
