"""The log of tracks (NDJSON and CSV files that grow line by line), and the results files of a run.

NDJSON is the log. CSV, SQLite and the annotated video are written during the run, and made again from the log when the
run is resumed. If a run writes no NDJSON, its log is the database or the CSV file.

A power cut or a full disk can truncate a file within a frame of several objects. In each frame, objects that were not
in the previous frame come first. Therefore the last frame is complete if it has all objects of the previous frame;
otherwise it is removed and tracked again.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby, pairwise
from math import isnan
from pathlib import Path
from typing import IO, Any, get_args

from catstream.base.addresses import is_live
from catstream.base.box import Box
from catstream.base.files import check_distinct, open_locked, writing
from catstream.base.names import UNNAMED, check_name
from catstream.base.tables import Columns, Row
from catstream.base.text import listed
from catstream.errors import VideoError
from catstream.output.database import read_database, read_database_header
from catstream.output.destinations import (
    Header,
    Origin,
    Sink,
    TrackedFrame,
    check_result,
    check_sink,
    is_file,
    open_sink,
)
from catstream.output.remote import Warnings
from catstream.processes.job import Results
from catstream.video.source import open_source
from catstream.wire.codec import decode_json
from catstream.wire.messages import Check, State, Track

#: The objects "before the first frame": the object without a name is written last.
_FIRST = frozenset({UNNAMED})

_COLUMNS = (
    *("frame", "seconds", "state", "x", "y", "w", "h"),
    *("score", "model_version", "object", "source_frame", "checked", "probability", "processing"),
)
_OPTIONAL = {"source_frame", "checked", "probability", "processing"}

_TIME = r"-\d{8}T\d{6}"  # part of the name of a rotated file


class LineSink(Sink):
    """A file with a line for each track. Written lines survive a crash of this process.

    An existing file is replaced, or continued after its first `origin.size` bytes. If another program removes, renames
    or truncates it, a warning is logged, and a new file with its own first line continues. After an error, `write` may
    be called with the next frame: no part of the failed frame remains, and a header contains the size of the gap.
    """

    def __init__(self, dest: str, origin: Origin) -> None:
        self.path, self._origin = Path(dest), origin
        self._previous = _FIRST if origin.last is None else _objects(origin.last)  # objects of the previous frame
        self._gap = origin.gap  # failed frames since the last written one
        self._is_rotated = False  # since the last written frame
        self._open(origin.size)

    @abstractmethod
    def head_line(self, gap: int = 0) -> str:
        """Return the first line of a file, or the line after a `gap`, without its line end; empty for no line."""

    @abstractmethod
    def line(self, track: Track, seconds: float) -> str:
        """Return the line of a track, without its line end."""

    def write(self, frame: TrackedFrame) -> None:
        """Add the lines of a frame."""
        tracks = sorted(frame.tracks, key=lambda track: track.object in self._previous)
        lines = [self.line(track, frame.seconds) for track in tracks]
        try:
            self._follow()
            with writing(self.path, VideoError):
                if self._gap:
                    self._remove_part()
                    lines = [*filter(None, [self.head_line(self._gap)]), *lines]
                self._write(lines)
        except VideoError:
            self._gap += 1
            with suppress(OSError, ValueError):  # the file may be closed
                self._remove_part()
            raise
        self._gap, self._is_rotated, self._previous = 0, False, _objects(frame)
        self._status = os.fstat(self._file.fileno())

    def must_rotate(self, now: float) -> bool:
        """Return True if the file is too large, or its last row is from an earlier period."""
        if (rotation := self._origin.options.rotate) is None:
            return False
        is_old = self._status.st_mtime // rotation.seconds < now // rotation.seconds
        return not self._is_rotated and (is_old or self._status.st_size > rotation.bytes)

    def rotate(self, now: float) -> None:
        """Rename the file, and remove the oldest rotated ones; the next frame begins a new file."""
        keep, target = self._origin.options.keep, _with_time(self.path, now)
        if target.exists() or not self.path.exists():  # already rotated in this second, or removed by another program
            return
        with writing(self.path, VideoError):
            self.path.rename(target)
            self._is_rotated = True
            name = re.compile(rf"{re.escape(self.path.stem)}{_TIME}{self.path.suffix}")
            rotated = sorted(file for file in self.path.parent.iterdir() if name.fullmatch(file.name))
            for file in rotated[:-keep] if keep else ():
                file.unlink()

    def close(self) -> None:
        """Close the file."""
        with writing(self.path, VideoError):
            self._file.close()

    def _write(self, lines: list[str]) -> None:
        """Write without a buffer, which would keep data after a failed write."""
        data = "".join(f"{line}\n" for line in lines).encode()
        while data:
            data = data[os.write(self._file.fileno(), data) :]

    def _remove_part(self) -> None:
        """Remove an incomplete frame after an error."""
        os.ftruncate(self._file.fileno(), self._status.st_size)

    def _open(self, size: int) -> None:
        self._file: IO[bytes] = open_locked(self.path, VideoError, size, mode="ab", buffering=0)
        with writing(self.path, VideoError), ExitStack() as stack:
            if (first := self.head_line()) and not size:  # if it cannot be written, remove the file
                stack.callback(self.path.unlink)
                stack.enter_context(self._file)
                self._write([first])
                stack.pop_all()
        self._status = os.fstat(self._file.fileno())

    def _follow(self) -> None:
        """Reopen the file if another program has removed, renamed or truncated it."""
        rest, problem = 0, "removed or renamed"
        with writing(self.path, VideoError), suppress(FileNotFoundError, NotADirectoryError):
            status = self.path.stat()
            if os.path.samestat(status, self._status):
                if status.st_size >= self._status.st_size:
                    return
                rest, problem = self.path.read_bytes().rfind(b"\n") + 1, "truncated"
        if not self._gap and not self._is_rotated:
            Warnings(str(self.path)).log(f"{problem} by another program; the log continues without the earlier rows")
        self._file.close()
        self._open(rest)


class NdjsonSink(LineSink):
    """A header, then a line of JSON for each track, with the fields of `Track.to_dict`."""

    def head_line(self, gap: int = 0) -> str:
        return replace(self._origin.header, gap=gap).to_json()

    def line(self, track: Track, _: float) -> str:
        return json.dumps(track.to_dict())


class StdoutSink(NdjsonSink):
    """NDJSON on standard output, without a header and unbuffered."""

    def __init__(self, _: str, origin: Origin) -> None:
        super().__init__("standard output", origin)

    def head_line(self, _: int = 0) -> str:
        return ""

    def _open(self, _: int) -> None:
        self._file = os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0)

    def _follow(self) -> None:
        pass

    def _remove_part(self) -> None:
        pass


class CsvSink(LineSink):
    """Comma-separated values; `processing` is the processing time of the frame, empty if unknown.

    `checked` and `probability` are empty except in an annotation.
    """

    def head_line(self, gap: int = 0) -> str:
        return "" if gap else ",".join(_COLUMNS)

    def line(self, track: Track, seconds: float) -> str:
        box = ",,," if track.box is None else ",".join(f"{side:.4f}" for side in track.box)
        processing = "" if isnan(seconds) else f"{seconds:.6f}"
        probability = "" if track.probability is None else f"{track.probability:.6f}"
        return (
            f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version},{track.object},"
            f"{track.source_frame},{track.checked},{probability},{processing}"
        )


#: The suffixes of all logs, in the order of preference for a resumed run.
LOGS = (".ndjson", ".sqlite", ".csv")


def is_log(path: Path) -> bool:
    """Return True if a file has a format from which a run can be resumed, by its name."""
    return path.suffix in LOGS


class Log:
    """Reads the tracks of a run from its log, which may be growing.

    A truncated last line and blank lines are ignored. Any other invalid line is a VideoError with its number, unless
    `skip_damaged`.

    damaged  number of skipped lines
    gap      number of missing frames, by the headers in the log
    """

    def __init__(self, path: Path, *, skip_damaged: bool = False) -> None:
        self.path, self.damaged, self.gap, self._skip = path, 0, 0, skip_damaged

    def header(self) -> Header | None:
        """Read the header; None without one, for example in a CSV file. VideoError if its version is unknown."""
        if self.path.suffix == ".sqlite":
            return read_database_header(self.path)
        with self.path.open("rb") as file:
            return Header.from_json(file.readline())

    def __iter__(self) -> Iterator[TrackedFrame]:
        """Yield the frames in order, even if the rows are not; nothing if the file does not exist.

        VideoError if an object has two rows in a frame.
        """
        if self.path.suffix == ".sqlite":
            yield from read_database(self.path)
            return
        tracks: Iterable[Track] = (track for track, _ in self._rows())
        is_sorted = all(one.frame <= other.frame for one, other in pairwise(tracks))
        tracks = (track for track, _ in self._rows())
        tracks = tracks if is_sorted else sorted(tracks, key=lambda track: track.frame)
        for number, group in groupby(tracks, lambda track: track.frame):
            frame = TrackedFrame([*group])
            names = [track.object for track in frame.tracks]
            if twice := {name for name in names if names.count(name) > 1}:
                raise VideoError(f"{self.path} has two rows of {listed(sorted(twice))} in frame {number}: remove one")
            yield frame

    def last_whole_frame(self) -> tuple[TrackedFrame | None, int]:
        """Return the last complete frame, or None, and the offset of its end in bytes."""
        last: tuple[TrackedFrame | None, int] = (None, 0)
        if self.path.suffix == ".sqlite":  # a frame is one transaction
            for frame in read_database(self.path):
                last = frame, 0
            return last
        previous = last
        for _, group in groupby((row for row in self._rows() if row[1]), lambda row: row[0].frame):
            rows = [*group]
            previous, last = last, (TrackedFrame([track for track, _ in rows]), rows[-1][1])
        # The last frame is complete if it has all objects of the previous frame.
        required = _FIRST if previous[0] is None else _objects(previous[0])
        return last if last[0] is None or required <= _objects(last[0]) else previous

    def _rows(self) -> Iterator[tuple[Track, int]]:
        """Yield each track, and the offset of the end of its line; 0 without a line end."""
        self.damaged = self.gap = 0
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            if self.path.suffix == ".csv" and not file.readline().endswith(b"\n"):  # a crash has truncated the names
                return
            file.seek(0)
            (start, parse), end = self._parser(), 0
            for number, line in enumerate(file, 1):
                end += len(line)
                if number <= start or not line.strip():
                    continue
                try:
                    track = parse(line.decode("utf-8-sig"))
                except ValueError as error:
                    header = Header.from_json(line)
                    if header is not None:  # at the start of a log, after a gap, or of an appended log
                        self.gap += header.gap
                    elif line.endswith(b"\n"):  # otherwise a crash has truncated the file
                        if not self._skip:
                            problem = f"{self.path}, line {number} is not a track ({error})"
                            raise VideoError(f"{problem}: pass --skip-damaged to continue after it") from None
                        self.damaged += 1
                    continue
                if track is not None:
                    yield track, end if line.endswith(b"\n") else 0

    def _parser(self) -> tuple[int, Callable[[str], Track | None]]:
        """Return the number of lines before the first track, and a parser for lines, which returns None for empty ones.

        VideoError if the columns of a CSV file are wrong.
        """
        if self.path.suffix != ".csv":
            return 0, lambda line: decode_json(line.encode(), Track)
        with self.path.open(encoding="utf-8-sig", errors="replace") as file:
            columns = Columns(self.path, file, [name for name in _COLUMNS if name not in _OPTIONAL])

        def parse(line: str) -> Track | None:
            row = columns.row(line, whole=True)
            return None if row is None else _parse_row(row)

        return columns.start, parse


def _with_time(path: Path, seconds: float) -> Path:
    """Return the name of a rotated file, with a time in UTC: names sort by time, and before the current file."""
    return path.with_stem(f"{path.stem}-{datetime.fromtimestamp(seconds, UTC):%Y%m%dT%H%M%S}")


def logs_of(files: Iterable[Path], *, skip_damaged: bool = False) -> list[Log]:
    """Return the logs of files, and the NDJSON logs of folders; VideoError if one is invalid or without tracks."""
    paths: list[Path] = []
    for path in files:
        candidates = sorted(path.glob("*.ndjson")) if path.is_dir() else [path]
        if not candidates:
            raise VideoError(f"{path} contains no .ndjson file: pass the output folder of a run or a batch")
        if not is_log(candidates[0]) or not candidates[0].is_file():
            problem = "is not the log of a run" if path.exists() else "does not exist"
            raise VideoError(f"{path} {problem}: pass one of a run's files, {', '.join(LOGS)}")
        paths += candidates
    logs = [Log(path, skip_damaged=skip_damaged) for path in paths]
    for log in logs:
        if next(iter(log), None) is None:
            raise VideoError(f"{log.path} contains no tracks")
    return logs


def join_rotated(logs: Iterable[Log]) -> list[Log]:
    """Join the rotated files of each run, whose names differ only in the time."""
    runs: dict[str, list[Log]] = {}
    for log in sorted(logs, key=lambda log: log.path.name):
        runs.setdefault(re.sub(_TIME, "", log.path.name), []).append(log)
    return [JoinedLog(run) if len(run) > 1 else run[0] for run in runs.values()]


class JoinedLog(Log):
    """The rotated files of one run as one log. VideoError if they have several sources or repeat a frame."""

    def __init__(self, logs: Iterable[Log]) -> None:
        self._logs = sorted(logs, key=lambda log: next(iter(log)).number)
        if len({(log.header() or Header()).source for log in self._logs}) > 1:
            raise VideoError("the logs have different sources: pass the files of one run, or --format yolo")
        super().__init__(self._logs[-1].path)

    def __iter__(self) -> Iterator[TrackedFrame]:
        last = -1
        for log in self._logs:
            for frame in log:
                if frame.number <= last:
                    raise VideoError(f"{log.path} has frame {frame.number} again: pass the files of one run")
                last = frame.number
                yield frame
        self.damaged = sum(log.damaged for log in self._logs)
        self.gap = sum(log.gap for log in self._logs)


def _parse_row(row: Row) -> Track:
    """Parse a row of a CSV file, which lacks `pts`, `began` and `doubtful`; ValueError if it is invalid."""
    box = Box(*(row.number(side) for side in "xywh")) if row.text("x") else None
    return Track(
        *(row.integer("frame"), row.number("seconds"), row.choice("state", get_args(State)), box, row.number("score")),
        model_version=row.integer("model_version"),
        object=check_name(row.text("object")),
        source_frame=row.integer("source_frame", default=-1),
        checked=row.choice("checked", get_args(Check)),
        probability=row.number("probability") if row.text("probability") else None,
    )


def _objects(frame: TrackedFrame) -> frozenset[str]:
    return frozenset(track.object for track in frame.tracks)


def destinations_of(name: str, results: Results) -> list[str]:
    """Return the unique destinations of a run: NDJSON, CSV and video named `name`, and further ones."""
    kinds = ("ndjson", "csv", *(["mp4"] if results.video else []))
    own = [] if results.output is None else [str(results.output / f"{name}.{kind}") for kind in kinds]
    return [*dict.fromkeys([*own, *map(str, results.write or ())])]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """All destinations of a run.

    A resumed run continues after the last complete frame of its log: the NDJSON file or, without one, the database or
    the CSV file. The other files are made again from the log.

    origin  the run whose tracks are written
    output  folder of the results, created if it does not exist, or None
    destinations  the unique destinations
    """

    origin: Origin
    output: Path | None
    destinations: list[str]

    def check(self, *, overwrite: bool, earlier: list[str], others: Mapping[str, Path] | None = None) -> None:
        """Raise VideoError before the run if a destination cannot be written or must not be overwritten.

        If `overwrite`, existing files may be replaced; files of an `earlier` part of this run are continued. All files
        must be different, including `others` that the run writes, by their purpose.
        """
        source = self.origin.header.source
        files = [(f"the destination {dest}", Path(dest)) for dest in self.destinations if is_file(dest)]
        check_distinct([*files, *(others or {}).items()], VideoError)
        for dest in self.destinations:
            check_sink(dest, self.origin.options, source)
            if is_file(dest):
                continued = dest in earlier and self._log() is not None
                if dest in earlier and not continued and Path(dest).exists():
                    raise VideoError(f"{dest} cannot be continued: pass other destinations to resume (--write DEST)")
                check_result(Path(dest), overwrite=overwrite or continued, source=source, made=self.output)

    def position(self, *, skip_damaged: bool = False) -> tuple[int | None, float]:
        """Return the number of the first frame to track, after the last complete one in the log, and the latter's time.

        None and 0 if the run has no log. VideoError if the log is damaged, unless `skip_damaged`.
        """
        if (path := self._log()) is None:
            return None, 0.0
        last, _ = Log(path, skip_damaged=skip_damaged).last_whole_frame()
        return (0, 0.0) if last is None else (last.number + 1, last.tracks[0].time)

    def missing(self) -> list[str]:
        """Return the files that do not exist, because another program has removed them."""
        return [dest for dest in self.destinations if is_file(dest) and not Path(dest).exists()]

    def is_complete(self, frames: int | None) -> bool:
        """Return True if there are destinations, all files with this number of `frames` (None if unknown)."""

        def count(dest: str) -> int | None:
            if is_log(Path(dest)):
                last, _ = Log(Path(dest), skip_damaged=True).last_whole_frame()
                return last and last.number + 1
            with suppress(VideoError), open_source(dest) as video:
                return video.frames
            return None

        return frames is not None and {*map(count, self.destinations)} == {frames}

    def opened(self, endpoint: str, *, resume: bool = False, skip_damaged: bool = False) -> OpenFiles:
        """Open all destinations for a pipeline at an endpoint; existing files are replaced, or continued if `resume`.

        VideoError if this fails.
        """
        origin = replace(self.origin, address=replace(self.origin.address, endpoint=endpoint))
        path = self._log() if resume else None  # before new files exist
        log = None if path is None else Log(path, skip_damaged=skip_damaged)
        last, size = (None, 0) if log is None else log.last_whole_frame()
        log_origin = replace(origin, last=last, size=size)
        origins = {dest: log_origin if Path(dest) == path else origin for dest in self.destinations}
        with ExitStack() as stack:
            outputs = stack.enter_context(OpenFiles(origins, is_live=is_live(origin.header.source)))
            for dest in self.destinations:
                outputs.write_to(dest)
            # The other files are made again from the log.
            followers = [dest for dest in self.destinations if is_file(dest) and Path(dest) != path]
            for frame in log if log is not None and last is not None and followers else ():
                for dest in followers:
                    outputs.write_to(dest, frame)
            stack.pop_all()
        return outputs

    def continued(self, endpoint: str, *, resume: bool) -> OpenFiles:
        """Open all destinations for an unattended run: creates folders, and renames files that are not continued.

        walk.ndjson is renamed to walk-20261128T133015.ndjson, by the time of its last change.
        """
        for dest in map(Path, filter(is_file, self.destinations)):
            with writing(dest, VideoError):
                dest.parent.mkdir(parents=True, exist_ok=True)
                if dest.is_file() and not (resume and self._log() is not None):
                    dest.rename(_with_time(dest, dest.stat().st_mtime))
        self.check(overwrite=True, earlier=[])
        return self.opened(endpoint, resume=resume)

    def _log(self) -> Path | None:
        """Return the log from which the run is resumed, existing or not; None without a log."""
        logs = (Path(dest) for dest in self.destinations if is_log(Path(dest)))
        return min(logs, key=lambda log: (not log.exists(), LOGS.index(log.suffix)), default=None)


class OpenFiles(AbstractContextManager["OpenFiles"]):
    """The open destinations of a run; each is opened by its first `write_to`.

    VideoError if one cannot be opened, written or completed.

    If the source `is_live`, the run continues instead: a frame that cannot be written is counted, and opening a
    destination is retried with each frame.

    not_written  number of frames that could not be written to all destinations
    """

    def __init__(self, origins: Mapping[str, Origin], *, is_live: bool) -> None:
        self._origins, self._is_live, self.not_written = origins, is_live, 0
        self._sinks: dict[str, Sink] = {}
        self._warnings, self._stack = Warnings("results"), ExitStack()

    @property
    def missed(self) -> int:
        """Frames that could not be written to all destinations, plus frames and messages that sinks missed."""
        return self.not_written + sum(sink.missed for sink in self._sinks.values())

    @property
    def trouble(self) -> str:
        """Current write errors; empty once all frames were written for some seconds."""
        return "; ".join(self._warnings.problems)

    def write(self, frame: TrackedFrame) -> None:
        """Write a frame to all destinations."""
        if self._is_live:
            self._rotate()
        written = [self.write_to(dest, frame) for dest in self._origins]
        if all(written):
            self._warnings.working()
        else:
            self.not_written += 1

    def write_to(self, dest: str, frame: TrackedFrame | None = None) -> bool:
        """Open a destination if necessary, and write a frame to it; returns False if this fails for a live source."""
        try:
            if dest not in self._sinks:
                sink = open_sink(dest, replace(self._origins[dest], gap=self.not_written))
                self._sinks[dest] = self._stack.enter_context(closing(sink))
            if frame is not None:
                self._sinks[dest].write(frame)
        except VideoError as error:
            if not self._is_live:
                raise
            self._warnings.failed(str(error))
            return False
        return True

    def _rotate(self) -> None:
        """Rotate all logs at the same frame, because a resumed run makes the others again from the newest one."""
        sinks, now = self._sinks.values(), time.time()
        logs = [sink for sink in sinks if isinstance(sink, LineSink) and not isinstance(sink, StdoutSink)]
        if any(log.must_rotate(now) for log in logs):
            for log in logs:
                try:
                    log.rotate(now)
                except VideoError as error:
                    self._warnings.failed(str(error))

    def idle(self) -> None:
        """Let the destinations do periodic work while no frame arrives."""
        for sink in self._sinks.values():
            sink.idle()

    def end(self) -> None:
        """End all destinations before `close` waits for the delivery to one of them."""
        for sink in self._sinks.values():
            sink.end()

    def __exit__(self, *details: Any) -> None:
        self.end()
        self._stack.__exit__(*details)
