"""The file formats of tracks, selected by the suffix of the file.

tracks.ndjson    a JSON object on each line, with the fields of `Track`; also tracks.jsonl, and - for standard output
tracks.json      one array of such objects
tracks.csv       a row for each object and frame, as in the results of `catstream track`
tracks.txt       MOT text, as the tools of MOTChallenge read it
tracks.sqlite    a table in a database that other programs may read meanwhile
tracks.parquet   a column store, written when it is closed
walk.mp4         the video with the tracks drawn in
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from catstream.errors import VideoError, require_extra
from catstream.messages.kinds import Track
from catstream.messages.storage import why_not_writable
from catstream.sinks import parquet
from catstream.sinks.csv import CsvSink
from catstream.sinks.json import JsonSink, NdjsonSink, StdoutSink
from catstream.sinks.mot import MotSink
from catstream.sinks.sqlite import SqliteSink
from catstream.sinks.video import VideoSink
from catstream.video.frames import RATE
from catstream.video.source import ALL_FRAMES

__all__ = ["STDOUT", "SUFFIXES", "Sink", "check_writable", "discard", "file_exists", "is_closed", "open_sink", "reader"]

#: Stands for standard output in place of a file.
STDOUT = Path("-")


class Sink(Protocol):
    """Takes the tracks in the order of frames. A track that was written survives a crash, except in a video."""

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame; raise VideoError if they cannot be written."""

    def close(self) -> None:
        """Complete the file; raise VideoError if it cannot be written. The tracks written before remain."""


class _Format(NamedTuple):
    """A file format.

    create  opens a sink: `create(path, keep)`, see `open_sink`
    tracks  reads the tracks of a file; None if the format does not hold all fields
    """

    create: Callable[[Path, int | None], Sink]
    tracks: Callable[[Path], Iterator[Track]] | None


_FORMATS = {
    ".ndjson": _Format(NdjsonSink, NdjsonSink.tracks),
    ".jsonl": _Format(NdjsonSink, NdjsonSink.tracks),
    ".json": _Format(JsonSink, JsonSink.tracks),
    ".csv": _Format(CsvSink, CsvSink.tracks),
    ".txt": _Format(MotSink, None),
    ".sqlite": _Format(SqliteSink, SqliteSink.tracks),
    ".parquet": _Format(parquet.ParquetSink, parquet.ParquetSink.tracks),
}

#: The suffixes of all formats.
SUFFIXES = (*_FORMATS, ".mp4")


def check_writable(path: Path, *, may_exist: bool = False) -> None:
    """Raise VideoError if a sink cannot be opened.

    Parameters
    ----------
    may_exist : whether the file may exist already
    """
    if path == STDOUT:
        return
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: the name of a file for tracks ends with {', '.join(SUFFIXES)}, or is - for stdout")
    if not may_exist and file_exists(path):
        raise VideoError(f"{path} exists already: give another name, or remove it")
    if path.suffix == ".parquet":
        require_extra("parquet")
    if reason := why_not_writable(path):
        raise VideoError(reason)


def file_exists(path: Path) -> bool:
    """Return whether a file exists, or one that belongs to it."""
    return path != STDOUT and any(file.exists() for file in _files(path))


def is_closed(path: Path) -> bool:
    """Return whether a file exists and is complete: no file that belongs to it is left beside it."""
    return path.exists() and not any(file.exists() for file in _files(path)[1:])


def reader(path: Path) -> Callable[[Path], Iterator[Track]] | None:
    """Return the function that reads the tracks of such a file; None if the format does not hold them all."""
    return _FORMATS[path.suffix].tracks if path.suffix in _FORMATS and path != STDOUT else None


def open_sink(
    path: Path,
    source: str | None = None,
    part: slice = ALL_FRAMES,
    *,
    image_rate: float = RATE,
    keep: int | None = None,
) -> Sink:
    """Open a file for tracks in the format of its suffix.

    Parameters
    ----------
    source, part, image_rate : those of the pipeline; the frames of a video are read again from there
    keep : continue an existing file after its tracks of the frames before this one, if its format holds all tracks;
        None for a new file

    Raises
    ------
    VideoError
        If a new file exists already or cannot be written, its suffix is unknown, or the source cannot be read.
    """
    check_writable(path, may_exist=keep is not None)
    if path == STDOUT:
        return StdoutSink(path)
    if path.suffix == ".mp4":
        if source is None:
            raise VideoError(f"{path} needs the frames: give their source (--source)")
        return VideoSink(path, source, part, image_rate)
    form = _FORMATS[path.suffix]
    if form.tracks is None and keep is not None:
        discard(path)
        keep = None
    try:
        return form.create(path, keep)
    except OSError as error:
        raise VideoError(f"cannot write {path} ({error.strerror}): give a path that you may write to") from None


def discard(path: Path) -> None:
    """Remove a file for tracks and the files that belong to it, if they exist.

    Raises
    ------
    VideoError
        If it cannot be removed.
    """
    try:
        for file in _files(path) if path != STDOUT else ():
            file.unlink(missing_ok=True)
    except OSError as error:
        raise VideoError(f"cannot replace {path} ({error.strerror}): give another name") from None


def _files(path: Path) -> list[Path]:
    """Return a file for tracks and the files beside it that hold some of the tracks until it is closed."""
    if path.suffix == ".sqlite":
        return [path, *(path.with_name(path.name + end) for end in ("-wal", "-shm"))]
    if path.suffix == ".parquet":
        return [path, *_files(parquet.database_of(path))]
    return [path]
