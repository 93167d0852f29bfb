"""The log of tracks: NDJSON and CSV files that grow line by line, and all results of a run, which it continues.

NDJSON is the log. CSV, SQLite and the annotated video follow it while the run goes on, and are made again from it when
the run is resumed; only if a run writes no NDJSON, the database or the CSV file is its log.

A power cut or a full disk can cut a file within a frame of several objects. In each frame, the objects that were not in
the frame before come first, so a last frame that has all objects of the frame before it is whole. Any other last frame
counts as not written: it is cut, and tracked again.
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

#: Stands for the objects of the frame before the first one: an object without a name is written last.
_FIRST = frozenset({UNNAMED})

_COLUMNS = (
    *("frame", "seconds", "state", "x", "y", "w", "h"),
    *("score", "model_version", "object", "source_frame", "checked", "probability", "processing"),
)
_OPTIONAL = {"source_frame", "checked", "probability", "processing"}

_TIME = r"-\d{8}T\d{6}"  # in the name of a rotated file


class LineSink(Sink):
    """A file with a line for each track. Written lines remain if this process crashes.

    An existing file is replaced, or continued after its first `origin.size` bytes. If it is removed, renamed or
    truncated meanwhile, that is logged, and a file with a first line of its own continues. After an error, `write` may
    be called again with the next frame: the file has no part of the frame before, and a header states the gap.
    """

    def __init__(self, dest: str, origin: Origin) -> None:
        self.path, self._origin = Path(dest), origin
        self._before = _FIRST if origin.last is None else _objects(origin.last)
        self._gap = origin.gap  # frames since the last one that was written
        self._is_rotated = False  # since the last one
        self._open(origin.size)

    @abstractmethod
    def head_line(self, gap: int = 0) -> str:
        """Return the first line of a file, or the one after a gap of some frames, without its end; empty for none."""

    @abstractmethod
    def line(self, track: Track, seconds: float) -> str:
        """Return the line of a track, without its line end."""

    def write(self, frame: TrackedFrame) -> None:
        """Add the lines of a frame."""
        tracks = sorted(frame.tracks, key=lambda track: track.object in self._before)
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
            with suppress(OSError, ValueError):  # it may be closed
                self._remove_part()
            raise
        self._gap, self._is_rotated, self._before = 0, False, _objects(frame)
        self._status = os.fstat(self._file.fileno())

    def must_rotate(self, now: float) -> bool:
        """Return whether the file is too large, or its last row is of an earlier period."""
        if (rotation := self._origin.options.rotate) is None:
            return False
        is_old = self._status.st_mtime // rotation.seconds < now // rotation.seconds
        return not self._is_rotated and (is_old or self._status.st_size > rotation.bytes)

    def rotate(self, now: float) -> None:
        """Rename the file, and remove the oldest renamed ones; the next frame begins a new file."""
        keep, target = self._origin.options.keep, _with_time(self.path, now)
        if target.exists() or not self.path.exists():  # from this second; removed by another program
            return
        with writing(self.path, VideoError):
            self.path.rename(target)
            self._is_rotated = True
            name = re.compile(rf"{re.escape(self.path.stem)}{_TIME}{self.path.suffix}")
            renamed = sorted(file for file in self.path.parent.iterdir() if name.fullmatch(file.name))
            for file in renamed[:-keep] if keep else ():
                file.unlink()

    def close(self) -> None:
        """Close the file."""
        with writing(self.path, VideoError):
            self._file.close()

    def _write(self, lines: list[str]) -> None:
        """Write without a buffer, which would keep what the disk did not take."""
        data = "".join(f"{line}\n" for line in lines).encode()
        while data:
            data = data[os.write(self._file.fileno(), data) :]

    def _remove_part(self) -> None:
        """Remove the part of a frame that was written before an error."""
        os.ftruncate(self._file.fileno(), self._status.st_size)

    def _open(self, size: int) -> None:
        self._file: IO[bytes] = open_locked(self.path, VideoError, size, mode="ab", buffering=0)
        with writing(self.path, VideoError), ExitStack() as stack:
            if (first := self.head_line()) and not size:  # a file with no room for it is removed
                stack.callback(self.path.unlink)
                stack.enter_context(self._file)
                self._write([first])
                stack.pop_all()
        self._status = os.fstat(self._file.fileno())

    def _follow(self) -> None:
        """Open a new file if another program has removed, renamed or truncated the file."""
        rest, problem = 0, "removed or renamed"
        with writing(self.path, VideoError), suppress(FileNotFoundError, NotADirectoryError):
            status = self.path.stat()
            if os.path.samestat(status, self._status):
                if status.st_size >= self._status.st_size:
                    return
                rest, problem = self.path.read_bytes().rfind(b"\n") + 1, "truncated"
        if not self._gap and not self._is_rotated:
            Warnings(str(self.path)).log(f"{problem} by another program; the log goes on there without the rows before")
        self._file.close()
        self._open(rest)


class NdjsonSink(LineSink):
    """After the header, a line of JSON for each track, as by `Track.to_dict`: a box is [x, y, w, h] or null."""

    def head_line(self, gap: int = 0) -> str:
        return replace(self._origin.header, gap=gap).to_json()

    def line(self, track: Track, _: float) -> str:
        return json.dumps(track.to_dict())


class StdoutSink(NdjsonSink):
    """The tracks on standard output, without a header; each frame is seen at once."""

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
    """Tracks as rows of comma-separated values; `processing` is the time that the frame took, empty if not known.

    `checked` and `probability` are empty but for an annotation.
    """

    def head_line(self, gap: int = 0) -> str:
        return "" if gap else ",".join(_COLUMNS)

    def line(self, track: Track, seconds: float) -> str:
        box = ",,," if track.box is None else ",".join(f"{side:.4f}" for side in track.box)
        took = "" if isnan(seconds) else f"{seconds:.6f}"
        probability = "" if track.probability is None else f"{track.probability:.6f}"
        return (
            f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version},{track.object},"
            f"{track.source_frame},{track.checked},{probability},{took}"
        )


#: The suffixes of all logs, in the order in which a run looks for the log to continue.
LOGS = (".ndjson", ".sqlite", ".csv")


def is_log(path: Path) -> bool:
    """Return whether a file of this name has all tracks of a run, and can be read and continued."""
    return path.suffix in LOGS


class Log:
    """A log, from which the tracks of a run are read. It may grow meanwhile.

    A line that was cut at the end of the file counts as not written, and blank lines are ignored. VideoError, with its
    number, for any other line that is no track; if `skip_damaged`, such lines are skipped.

    damaged  number of lines that were skipped
    gap      number of frames that the log states as missing
    """

    def __init__(self, path: Path, *, skip_damaged: bool = False) -> None:
        self.path, self.damaged, self.gap, self._skip = path, 0, 0, skip_damaged

    def header(self) -> Header | None:
        """Read the header; None if there is none, as in a CSV file. VideoError if another version has written it."""
        if self.path.suffix == ".sqlite":
            return read_database_header(self.path)
        with self.path.open("rb") as file:
            return Header.from_json(file.readline())

    def __iter__(self) -> Iterator[TrackedFrame]:
        """Yield the frames in their order, in whichever order the rows are; none if there is no file.

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
        """Return the last frame that is complete, None if there is none, and the byte at which it ends."""
        last: tuple[TrackedFrame | None, int] = (None, 0)
        if self.path.suffix == ".sqlite":  # a frame is one transaction
            for frame in read_database(self.path):
                last = frame, 0
            return last
        before = last
        for _, group in groupby((row for row in self._rows() if row[1]), lambda row: row[0].frame):
            rows = [*group]
            before, last = last, (TrackedFrame([track for track, _ in rows]), rows[-1][1])
        # The last frame is complete if it has all objects of the frame before it.
        required = _FIRST if before[0] is None else _objects(before[0])
        return last if last[0] is None or required <= _objects(last[0]) else before

    def _rows(self) -> Iterator[tuple[Track, int]]:
        """Yield each track, and the byte at which its line ends; 0 without an end."""
        self.damaged = self.gap = 0
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            if self.path.suffix == ".csv" and not file.readline().endswith(b"\n"):  # a crash has cut the names
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
                    if header is not None:  # the first line of a log, a gap, an appended log
                        self.gap += header.gap
                    elif line.endswith(b"\n"):  # else a crash has cut the file
                        if not self._skip:
                            problem = f"{self.path}, line {number} is no track ({error})"
                            raise VideoError(f"{problem}: pass --skip-damaged to continue after it") from None
                        self.damaged += 1
                    continue
                if track is not None:
                    yield track, end if line.endswith(b"\n") else 0

    def _parser(self) -> tuple[int, Callable[[str], Track | None]]:
        """Return the number of lines before the first track, and the function that parses a line: None if it is empty.

        VideoError if the names of the columns of a CSV file are wrong.
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
    """Return the name of a file that is renamed: the names sort by the time, in UTC, and before the newest one."""
    return path.with_stem(f"{path.stem}-{datetime.fromtimestamp(seconds, UTC):%Y%m%dT%H%M%S}")


def logs_of(files: Iterable[Path], *, skip_damaged: bool = False) -> list[Log]:
    """Return logs, and the NDJSON logs of folders; VideoError if one is no log, or contains no tracks."""
    paths: list[Path] = []
    for path in files:
        found = sorted(path.glob("*.ndjson")) if path.is_dir() else [path]
        if not found:
            raise VideoError(f"{path} contains no .ndjson file: pass the output folder of a run or a batch")
        if not is_log(found[0]) or not found[0].is_file():
            problem = "is not the log of a run" if path.exists() else "does not exist"
            raise VideoError(f"{path} {problem}: pass one of a run's files, {', '.join(LOGS)}")
        paths += found
    logs = [Log(path, skip_damaged=skip_damaged) for path in paths]
    for log in logs:
        if next(iter(log), None) is None:
            raise VideoError(f"{log.path} contains no tracks")
    return logs


def join_rotated(logs: Iterable[Log]) -> list[Log]:
    """Join the rotated files of each run, whose names differ in the time."""
    runs: dict[str, list[Log]] = {}
    for log in sorted(logs, key=lambda log: log.path.name):
        runs.setdefault(re.sub(_TIME, "", log.path.name), []).append(log)
    return [JoinedLog(run) if len(run) > 1 else run[0] for run in runs.values()]


class JoinedLog(Log):
    """The rotated files of one run, read as one log. VideoError if they are of several sources, or repeat a frame."""

    def __init__(self, logs: Iterable[Log]) -> None:
        self._logs = sorted(logs, key=lambda log: next(iter(log)).number)
        if len({(log.header() or Header()).source for log in self._logs}) > 1:
            raise VideoError("the logs are of several sources: pass the files of one run, or --format yolo")
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
    """The track of a row of a CSV file; raise ValueError if it is none.

    It has no `pts`, `began` and `doubtful`, which are not in the file.
    """
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
    """Return the destinations of a run of this name, each once: the log in both forms, the video, and further ones."""
    kinds = ("ndjson", "csv", *(["mp4"] if results.video else []))
    own = [] if results.output is None else [str(results.output / f"{name}.{kind}") for kind in kinds]
    return [*dict.fromkeys([*own, *map(str, results.write or ())])]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """All destinations of a run.

    A resumed run continues after the last whole frame of its log: the NDJSON file, or without one the database or the
    CSV file. The other files are made again from the log.

    origin  the source of the run, and the frames that are tracked
    output  folder of the results, which is made if it does not exist; None for none
    destinations  the destinations, each once
    """

    origin: Origin
    output: Path | None
    destinations: list[str]

    def check(self, *, overwrite: bool, earlier: list[str], others: Mapping[str, Path] | None = None) -> None:
        """Raise VideoError before the run if a destination cannot be written, or must not be.

        If `overwrite`, existing files may be replaced; files of an `earlier` part of this run are continued. All files,
        also the `others` that the run writes, by their purpose, have to be different.
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
        """Return the number of the frame after the last whole one of the log, and the seconds of that one.

        None and 0 if there is to be no log; VideoError if it is damaged, unless damaged lines are skipped.
        """
        if (path := self._log()) is None:
            return None, 0.0
        last, _ = Log(path, skip_damaged=skip_damaged).last_whole_frame()
        return (0, 0.0) if last is None else (last.number + 1, last.tracks[0].time)

    def missing(self) -> list[str]:
        """Return the files that do not exist, as another program has removed them."""
        return [dest for dest in self.destinations if is_file(dest) and not Path(dest).exists()]

    def is_complete(self, frames: int | None) -> bool:
        """Return whether all destinations, at least one, are files that have this number of frames, None if unknown."""

        def count(dest: str) -> int | None:
            if is_log(Path(dest)):
                last, _ = Log(Path(dest), skip_damaged=True).last_whole_frame()
                return last and last.number + 1
            with suppress(VideoError), open_source(dest) as video:
                return video.frames
            return None

        return frames is not None and {*map(count, self.destinations)} == {frames}

    def opened(self, endpoint: str, *, resume: bool = False, skip_damaged: bool = False) -> OpenFiles:
        """Open all destinations beside a pipeline; existing files are replaced.

        If `resume`, they continue after `position`. VideoError if that is not possible.
        """
        origin = replace(self.origin, address=replace(self.origin.address, endpoint=endpoint))
        path = self._log() if resume else None  # before new ones exist
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
        """The same for an unattended run: a file that is not continued is renamed, and folders are created.

        walk.ndjson becomes walk-20261128T133015.ndjson, by the time of its last change.
        """
        for dest in map(Path, filter(is_file, self.destinations)):
            with writing(dest, VideoError):
                dest.parent.mkdir(parents=True, exist_ok=True)
                if dest.is_file() and not (resume and self._log() is not None):
                    dest.rename(_with_time(dest, dest.stat().st_mtime))
        self.check(overwrite=True, earlier=[])
        return self.opened(endpoint, resume=resume)

    def _log(self) -> Path | None:
        """Return the log that is continued, None if there is to be none."""
        logs = (Path(dest) for dest in self.destinations if is_log(Path(dest)))
        return min(logs, key=lambda log: (not log.exists(), LOGS.index(log.suffix)), default=None)


class OpenFiles(AbstractContextManager["OpenFiles"]):
    """All destinations of a run while it continues; each is opened by its first `write_to`.

    VideoError if one cannot be opened, written or completed.

    If the source `is_live`, the run continues instead: a frame that cannot be written is counted, and a destination
    that could not be opened is tried again with each frame.

    not_written  frames that at least one destination lacks, as it could not be written
    """

    def __init__(self, origins: Mapping[str, Origin], *, is_live: bool) -> None:
        self._origins, self._is_live, self.not_written = origins, is_live, 0
        self._sinks: dict[str, Sink] = {}
        self._warnings, self._stack = Warnings("results"), ExitStack()

    @property
    def missed(self) -> int:
        """Frames that could not be written everywhere, and messages that a destination on the network has missed."""
        return self.not_written + sum(sink.missed for sink in self._sinks.values())

    @property
    def trouble(self) -> str:
        """Why frames could not be written; empty once all were written for some seconds."""
        return "; ".join(self._warnings.problems)

    def write(self, frame: TrackedFrame) -> None:
        """Write a frame everywhere."""
        if self._is_live:
            self._rotate()
        written = [self.write_to(dest, frame) for dest in self._origins]
        if all(written):
            self._warnings.working()
        else:
            self.not_written += 1

    def write_to(self, dest: str, frame: TrackedFrame | None = None) -> bool:
        """Open a destination if it is not open, and write a frame to it; return whether that was possible."""
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
        """Rotate all logs at the same frame: a resumed run makes them again from the newest one."""
        sinks, now = self._sinks.values(), time.time()
        logs = [sink for sink in sinks if isinstance(sink, LineSink) and not isinstance(sink, StdoutSink)]
        if any(log.must_rotate(now) for log in logs):
            for log in logs:
                try:
                    log.rotate(now)
                except VideoError as error:
                    self._warnings.failed(str(error))

    def idle(self) -> None:
        """Tell the destinations that no frame has arrived for a while."""
        for sink in self._sinks.values():
            sink.idle()

    def end(self) -> None:
        """Tell the destinations that no frame follows, before one of them waits for its delivery."""
        for sink in self._sinks.values():
            sink.end()

    def __exit__(self, *details: Any) -> None:
        self.end()
        self._stack.__exit__(*details)
