"""The file formats of tracks, selected by the suffix of the file.

tracks.ndjson    a JSON object on each line, with the fields of `Track`; also tracks.jsonl, and - for standard output
tracks.csv       a row for each object and frame, as in the results of `catstream track`
tracks.txt       MOT text, as the tools of MOTChallenge read it
walk.mp4         the video with the tracks drawn in
tracks.json      and .sqlite, .parquet: made at the end from tracks.ndjson, see `catstream.sinks.made`
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Protocol

from catstream.errors import VideoError, require_extra
from catstream.messages.kinds import Track
from catstream.messages.storage import why_not_writable, writing
from catstream.sinks.formats import CsvSink, MotSink, NdjsonSink, StdoutSink
from catstream.sinks.lines import LineSink
from catstream.sinks.made import MADE, make
from catstream.sinks.video import VideoSink
from catstream.video.frames import RATE
from catstream.video.source import ALL_FRAMES

#: Stands for standard output in place of a file.
STDOUT = Path("-")

_FORMATS: dict[str, type[LineSink]] = {".ndjson": NdjsonSink, ".jsonl": NdjsonSink, ".csv": CsvSink, ".txt": MotSink}

#: The suffixes of all formats.
SUFFIXES = (*_FORMATS, ".mp4", *MADE)


class Sink(Protocol):
    """Takes the tracks in the order of frames. A track that was written survives a crash, except in a video."""

    def write(self, tracks: Sequence[Track]) -> None:
        """Add the tracks of a frame; raise VideoError if they cannot be written."""

    def publish(self) -> None:
        """Take the place of a file that is written again; raise VideoError if that is impossible."""

    def close(self) -> None:
        """Complete the file; raise VideoError if it cannot be written. The tracks written before remain."""


def check_writable(path: Path, *, may_exist: bool = False, made: Path | None = None) -> None:
    """Raise VideoError if a file cannot be written, or if it exists and may not.

    Parameters
    ----------
    may_exist : whether the file may exist already
    made : a folder that is made before the file, if it does not exist
    """
    if path == STDOUT:
        return
    if path.suffix not in SUFFIXES:
        raise VideoError(f"{path}: the name of a file for tracks ends with {', '.join(SUFFIXES)}, or is - for stdout")
    if not may_exist and path.exists():
        raise VideoError(f"{path} exists already: give another name, or remove it")
    if path.suffix == ".parquet":
        require_extra("parquet")
    if reason := why_not_writable(path, made):
        raise VideoError(reason)


def exists(path: Path) -> bool:
    """Return whether a file exists; standard output is none."""
    return path != STDOUT and path.exists()


def with_logs(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and the NDJSON files from which some of them are made, each once."""
    return list(dict.fromkeys([*paths, *map(_log, paths)]))


def reader(path: Path) -> Callable[[Path], Iterator[Track]] | None:
    """Return the function that reads the tracks of such a file; None if the format does not hold them all."""
    form = _FORMATS.get(path.suffix)
    return form.tracks if form in (NdjsonSink, CsvSink) else None


@contextmanager
def open_files(
    paths: Sequence[Path],
    source: str | None = None,
    part: slice = ALL_FRAMES,
    *,
    image_rate: float = RATE,
    again: bool = False,
) -> Iterator[list[Sink]]:
    """Open files for tracks, each in the format of its suffix; at the end close them, and make the other formats.

    Parameters
    ----------
    source, part, image_rate : those of the pipeline; the frames of a video are read again from there
    again : whether existing files are written again, see `LineFile`; otherwise a file must not exist

    Raises
    ------
    VideoError
        If a file exists already or cannot be written, its suffix is unknown, or the source cannot be read.
    """
    for path in with_logs(paths):
        check_writable(path, may_exist=again)
        if again and path.suffix not in _FORMATS:  # these are there only if they are complete
            discard(path)
    with ExitStack() as stack:
        logs = dict.fromkeys(map(_log, paths))
        sinks = [stack.enter_context(closing(_open(path, source, part, image_rate, again))) for path in logs]
        try:
            yield sinks
        finally:
            stack.close()
            for path in paths:
                if path.suffix in MADE:
                    make(path, _log(path))


def _open(path: Path, source: str | None, part: slice, image_rate: float, again: bool) -> Sink:
    if path == STDOUT:
        return StdoutSink(path)
    if path.suffix == ".mp4":
        if source is None:
            raise VideoError(f"{path} needs the frames: give their source (--source)")
        return VideoSink(path, source, part, image_rate)
    with writing(path, VideoError):
        return _FORMATS[path.suffix](path, again=again)


def discard(path: Path) -> None:
    """Remove a file for tracks, if it exists.

    Raises
    ------
    VideoError
        If it cannot be removed.
    """
    if path != STDOUT:
        with writing(path, VideoError):
            path.unlink(missing_ok=True)


def _log(path: Path) -> Path:
    """Return the file to which tracks are written during a run: of a format that is made at the end, an NDJSON file."""
    return path.with_suffix(".ndjson") if path.suffix in MADE else path
