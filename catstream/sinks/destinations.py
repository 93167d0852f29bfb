"""THE TABLE of destinations and formats of tracks.

A sink takes each frame while the run goes on: `catstream track --write DEST`, `catstream sink DEST`. An export is made
from a log, an NDJSON or CSV file, afterwards: `catstream export LOG DEST`. A new one is a row here, a class or a
function in a file of its own, and a line in docs/how-to/sinks.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from math import nan
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from catstream.errors import VideoError, require_extra
from catstream.messages.kinds import Track
from catstream.messages.storage import why_not_writable, writing
from catstream.video.frames import RATE
from catstream.video.source import ALL_FRAMES

#: Stands for standard output.
STDOUT = "-"


class TrackedFrame(NamedTuple):
    """The tracks of a frame, at least one; a subscriber receives them one by one, and passes on one at a time.

    seconds  processing time of the frame, NaN if it is not known
    """

    tracks: Sequence[Track]
    seconds: float = nan

    @property
    def number(self) -> int:
        """Number of the frame."""
        return self.tracks[0].frame


@dataclass(frozen=True, slots=True)
class Origin:
    """The run whose tracks a sink writes.

    source      of its frames if they can be read a second time: None beside a running pipeline
    part        the frames that are tracked
    image_rate  frames per second of a folder of images
    endpoint    of the running pipeline, for a sink that receives other messages, too
    keys        folder of the keys for this endpoint
    last        number of the last frame in the log of a run that is resumed; -1 for a new run
    """

    source: str | None = None
    part: slice = field(default_factory=lambda: ALL_FRAMES)
    image_rate: float = RATE
    endpoint: str = ""
    keys: str = ""
    last: int = -1


class Sink(Protocol):
    """Takes the frames in their order; made as `Class(place, origin)`.

    A sink may have the attribute `last`, the number of the last frame that it holds, -1 for none: when a run is
    resumed, it gets all later frames of the log first.
    """

    def write(self, frame: TrackedFrame) -> None:
        """Add a frame; raise VideoError if that is not possible."""

    def close(self) -> None:
        """Complete what was written, which remains; raise VideoError if that is not possible."""


@dataclass(frozen=True, slots=True)
class Destination:
    """A row of the table.

    name      of the format, for `catstream export --format`
    key       what selects it: the suffix of a file, the scheme of an address ("mqtt://"), or "-"; empty for a folder
    home      the class of a sink, or the function `export(frames, path, name)`
    meaning   a line of the help
    extra     the extra that it needs
    is_sink   whether it is a sink
    repeats   whether it can be continued, or made again from the log, when a run is resumed
    """

    name: str
    key: str
    home: str
    meaning: str
    extra: str = ""
    is_sink: bool = False
    repeats: bool = True

    def load(self) -> Any:
        """Import the class or function."""
        if self.extra:
            require_extra(self.extra)
        module, _, name = self.home.rpartition(".")
        return getattr(import_module(f"catstream.sinks.{module}"), name)


def _sink(name: str, key: str, home: str, meaning: str, **options: Any) -> Destination:
    return Destination(name, key, home, meaning, is_sink=True, **options)


TABLE = (
    _sink("ndjson", ".ndjson", "track_log.NdjsonSink", "one JSON object per line, with the fields of a track"),
    _sink("stdout", STDOUT, "track_log.StdoutSink", "the same, on standard output", repeats=False),
    _sink("csv", ".csv", "track_log.CsvSink", "a row for each object and frame: frame, seconds, state, box, score ..."),
    _sink("video", ".mp4", "video_sink.open_video", "the frames with their boxes drawn in"),
    _sink("mcap", ".mcap", "mcap_sink.McapSink", "tracks, models, health and pictures; for Foxglove", extra="mcap",
          repeats=False),
    Destination("mot", ".txt", "exports.write_mot", "MOT text: frame,id,x,y,w,h,score,-1,-1,-1, counted from 1"),
    Destination("sqlite", ".sqlite", "exports.write_sqlite", "the table tracks of a database"),
    Destination("parquet", ".parquet", "exports.write_parquet", "the same columns in a column store", extra="parquet"),
    Destination("otb", "", "exports.write_otb", "a folder: boxes, confidence and times of each object, as for OTB"),
    Destination("got10k", "", "exports.write_got10k", "the same in the layout of GOT-10k"),
    Destination("vot", "", "exports.write_vot", "the same in the layout of VOT's long-term experiment"),
)  # fmt: skip

_SINKS = {row.key: row for row in TABLE if row.is_sink}
_EXPORTS = {row.name: row for row in TABLE if not row.is_sink}

#: The names of the formats of `export`.
FORMATS = tuple(_EXPORTS)


def table_help(*, sinks: bool) -> str:
    """Return a paragraph for the help of a command, with a line for each sink or export."""
    lines = [(row.key if sinks else row.name, row.meaning) for row in TABLE if row.is_sink is sinks]
    return "\b\n" + "\n".join(f"  {key:9} {meaning}" for key, meaning in lines)


def sink_of(place: str) -> Destination:
    """Return the row of a sink.

    Raises
    ------
    VideoError
        If there is none for this suffix or scheme.
    """
    scheme, is_address, _ = place.partition("://")
    row = _SINKS.get(f"{scheme}://" if is_address else place if place == STDOUT else Path(place).suffix)
    if row is None:
        raise VideoError(
            f"{place}: tracks are written to a file that ends with {', '.join(_files())}, or to - (standard output); "
            "for other formats use catstream export"
        )
    return row


def export_of(path: Path, name: str | None) -> Destination:
    """Return the row of an export, by its name, or else by the suffix of the file.

    Raises
    ------
    VideoError
        If there is none, or several, for this suffix.
    """
    rows = (
        [row for row in _EXPORTS.values() if row.key and row.key == path.suffix] if name is None else [_EXPORTS[name]]
    )
    if len(rows) != 1:
        raise VideoError(
            f"the name of {path} does not say which format it has: give --format, one of {', '.join(FORMATS)}"
        )
    return rows[0]


def is_file(place: str) -> bool:
    """Return whether a destination is a file: not standard output, and no address."""
    return place != STDOUT and "://" not in place


def absolute(place: str) -> str:
    """Return a destination with the whole path of a file."""
    return str(Path(place).absolute()) if is_file(place) else place


def check_file(path: Path, *, may_exist: bool, source: str = "", made: Path | None = None) -> None:
    """Raise VideoError if a file exists and may not, is the source of the frames, or cannot be written.

    Parameters
    ----------
    made : a folder that is made before the file, if it does not exist
    """
    if source and path.exists() and Path(source).exists() and path.samefile(source):
        raise VideoError(f"{path} is the source, which would be lost: give another name or folder")
    if path.exists() and not may_exist:
        raise VideoError(f"{path} exists already: replace it with --overwrite, or give another name")
    if reason := why_not_writable(path, made):
        raise VideoError(reason)


def open_sink(place: str, origin: Origin) -> Sink:
    """Open the sink of a destination; raises VideoError or MissingExtraError if that is not possible."""
    sink: Sink = sink_of(place).load()(place, origin)
    return sink


def export(frames: Iterable[TrackedFrame], path: Path, row: Destination, name: str) -> None:
    """Make a file or a folder from the frames of a log; a file gets its name once it is complete.

    Parameters
    ----------
    name : of the source or the log, for the files in a folder

    Raises
    ------
    VideoError
        If it cannot be written.
    """
    make: Callable[[Iterable[TrackedFrame], Path, str], None] = row.load()
    part = path.with_name(f"{path.name}.part") if row.key else path
    with writing(path, VideoError):
        try:
            make(frames, part, name)
            if part != path:
                part.replace(path)
        finally:
            if part != path:
                part.unlink(missing_ok=True)


def _files() -> list[str]:
    return [key for key in _SINKS if key.startswith(".")]
