"""The log of tracks, NDJSON and CSV files that grow line by line, and all files of a run, which it continues.

A power cut or a full disk can cut a file within a frame of several objects. In each frame, the objects that were not in
the frame before come first, so a last frame that has all objects of the frame before it is whole. Any other last frame
counts as not written: it is cut, and tracked again.
"""

from __future__ import annotations

import json
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from math import isnan, nan
from pathlib import Path
from typing import IO, get_args

from catstream.base.addresses import without_password
from catstream.base.box import Box
from catstream.base.files import writing
from catstream.base.names import UNNAMED, check_name
from catstream.errors import VideoError
from catstream.jobs.job import Results
from catstream.messages.kinds import State, Track
from catstream.sinks.database import read_database, read_database_head
from catstream.sinks.destinations import (
    Head,
    Origin,
    TrackedFrame,
    check_result,
    check_sink,
    is_file,
    open_sink,
    sink_of,
)
from catstream.video.source import is_live

_STATES: dict[str, State] = {state: state for state in get_args(State)}

#: Stands for the objects of the frame before the first one: an object without a name is written last.
_FIRST = frozenset({UNNAMED})


class LineSink(ABC):
    """A file with a line for each track. What was written remains, however this process ends.

    An existing file is replaced; if the run is resumed, it is cut after the frame `origin.last` and continued. `last`
    is the number of the last frame in it, -1 for none.
    """

    def __init__(self, place: str, origin: Origin) -> None:
        self.path, self.last, self._before = Path(place), -1, _FIRST
        end = 0
        for frame, after in whole_frames(self.path) if origin.last >= 0 else ():
            if frame.number > origin.last:
                break
            self.last, self._before, end = frame.number, _objects(frame), after
        with writing(self.path, VideoError), ExitStack() as stack:
            if end:
                os.truncate(self.path, end)
            self._file = self._open("a" if end else "w")
            if (first := self.first_line(origin)) and not end:  # a file with no room for it is closed and removed
                stack.callback(self.path.unlink)
                stack.enter_context(self._file)
                self._file.write(f"{first}\n")
                stack.pop_all()

    @abstractmethod
    def first_line(self, origin: Origin) -> str:
        """Return the first line of a file, without its line end; empty for none."""

    @abstractmethod
    def line(self, track: Track, seconds: float) -> str:
        """Return the line of a track, without its line end."""

    @staticmethod
    @abstractmethod
    def parse(line: str) -> tuple[Track, float]:
        """Return what `line` got; raise ValueError, KeyError or TypeError if it is no such line."""

    def write(self, frame: TrackedFrame) -> None:
        """Add the lines of a frame, in one write."""
        tracks = sorted(frame.tracks, key=lambda track: track.object in self._before)
        self._before = _objects(frame)
        with writing(self.path, VideoError):
            self._file.write("".join(f"{self.line(track, frame.seconds)}\n" for track in tracks))

    def close(self) -> None:
        """Close the file; a line for which the disk had no room is tried again."""
        with writing(self.path, VideoError):
            self._file.close()

    def _open(self, mode: str) -> IO[str]:
        return self.path.open(mode, encoding="utf-8", buffering=1)


class NdjsonSink(LineSink):
    """After the head, a line of JSON for each track, as by `Track.to_dict`: a box is [x, y, w, h] or null."""

    def first_line(self, origin: Origin) -> str:
        return origin.head.to_json()

    def line(self, track: Track, _: float) -> str:
        return json.dumps(track.to_dict())

    @staticmethod
    def parse(line: str) -> tuple[Track, float]:
        fields = json.loads(line)
        known = {name: value for name, value in fields.items() if name in Track.__dataclass_fields__}
        return Track(**{**known, "box": fields["box"] and Box(*fields["box"])}), nan


class StdoutSink(NdjsonSink):
    """The tracks on standard output, without a head; each frame is seen at once."""

    def __init__(self, _: str, __: Origin) -> None:
        super().__init__("standard output", Origin())
        self.last = sys.maxsize  # what a run has printed before it was resumed is not repeated

    def first_line(self, _: Origin) -> str:
        return ""

    def _open(self, _: str) -> IO[str]:
        return os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8", buffering=1)


class CsvSink(LineSink):
    """Tracks as rows of comma-separated values; `processing` is the time that the frame took, empty if not known."""

    header = "frame,seconds,state,x,y,w,h,score,model_version,object,source_frame,processing"

    def first_line(self, _: Origin) -> str:
        return self.header

    def line(self, track: Track, seconds: float) -> str:
        box = ",,," if track.box is None else ",".join(f"{side:.4f}" for side in track.box)
        took = "" if isnan(seconds) else f"{seconds:.6f}"
        score = f"{track.score:.6f},{track.model_version}"
        return f"{track.frame},{track.time:.6f},{track.state},{box},{score},{track.object},{track.source_frame},{took}"

    @staticmethod
    def parse(line: str) -> tuple[Track, float]:
        """The track has no `pts`, which is not in the file, and the `seq` of a run without a skipped frame."""
        frame, seconds, state, x, y, w, h, score, version, name, source, took = line.removesuffix("\n").split(",")
        box = Box(*map(float, (x, y, w, h))) if x else None
        number, name = int(frame), check_name(name)
        track = Track(
            *(number + 1, number, float(seconds), _STATES[state], box, float(score), int(version)),
            object=name,
            source_frame=int(source),
        )
        return track, float(took or nan)


_LOGS: dict[str, type[LineSink]] = {".ndjson": NdjsonSink, ".csv": CsvSink}

#: The suffixes of all logs; of several, a run is continued after the first one that exists.
LOGS = (".ndjson", ".sqlite", ".csv")


def is_log(path: Path) -> bool:
    """Return whether a file of this name has all tracks of a run, and can be read and continued."""
    return path.suffix in LOGS


def read_head(path: Path) -> Head | None:
    """Return the head of a log; None if it has none, as a CSV file.

    VideoError if another version of the format wrote it.
    """
    if path.suffix == ".sqlite":
        return read_database_head(path)
    with path.open("rb") as file:
        return Head.from_json(file.readline())


def _is_first_line(line: bytes) -> bool:
    """Whether a line is that before the tracks: the head, or the names of the columns."""
    return line.startswith((b'{"catstream":', b"frame,"))


def read_frames(path: Path) -> Iterator[tuple[TrackedFrame, int]]:
    """Yield each frame of a log, and the byte at which it ends, up to the first line that is incomplete."""
    if path.suffix == ".sqlite":
        yield from ((frame, 0) for frame in read_database(path))
        return
    kind = _LOGS[path.suffix]
    tracks: list[Track] = []
    seconds = nan
    with suppress(FileNotFoundError), path.open("rb") as file:
        end = len(first) if _is_first_line(first := file.readline()) else 0
        file.seek(end)
        for line in file:
            try:
                track, took = kind.parse(line.decode())
            except (KeyError, TypeError, ValueError):  # a power cut can leave zeros at the end
                break
            if not line.endswith(b"\n"):
                break
            if tracks and track.frame != tracks[0].frame:
                yield TrackedFrame(tracks, seconds), end
                tracks = []
            tracks.append(track)
            seconds, end = took, end + len(line)
        if tracks:
            yield TrackedFrame(tracks, seconds), end


def whole_frames(path: Path) -> Iterator[tuple[TrackedFrame, int]]:
    """Yield the same, except for a last frame that may be incomplete."""
    before = _FIRST
    for each, later in pairwise(chain(read_frames(path), [None])):
        if each is not None and (later is not None or before <= _objects(each[0])):
            yield each
            before = _objects(each[0])


def _objects(frame: TrackedFrame) -> frozenset[str]:
    return frozenset(track.object for track in frame.tracks)


def places_of(name: str, results: Results) -> list[str]:
    """Return the destinations of a run of this name, each once: the log in both forms, the video, and further ones."""
    kinds = ("ndjson", "csv", *(["mp4"] if results.video else []))
    own = [] if results.output is None else [str(results.output / f"{name}.{kind}") for kind in kinds]
    return [*dict.fromkeys([*own, *results.write])]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """All destinations of a run.

    A resumed run continues after the last frame that its log holds whole: an NDJSON file or a database, which have all
    digits, or else a CSV file. All its logs are cut after that frame; one that is shorter or new gets the frames that
    it lacks from the first one, and a video is drawn again.

    origin  the source of the run, and the frames that are tracked
    output  folder of the results, which is made; None for none
    places  the destinations, each once
    """

    origin: Origin
    output: Path | None
    places: list[str]

    def check(self, *, overwrite: bool, earlier: list[str]) -> None:
        """Raise VideoError or MissingExtraError before the run if a destination cannot be written, or must not be.

        If `overwrite`, existing files may be replaced; those of an `earlier` part of this run are continued.
        """
        source = self.origin.source or ""
        for place in self.places:
            row = sink_of(place)
            check_sink(place, self.origin.options)
            if is_file(place) and place.endswith(".mp4") and is_live(source):
                raise VideoError(
                    f"a video needs its frames once more, but {without_password(source)} is live: omit the video"
                )
            if is_file(place):
                continued = place in earlier and row.repeats and self._log() is not None
                if place in earlier and not continued and Path(place).exists():
                    raise VideoError(f"{place} cannot be continued: to resume, give other destinations (--write DEST)")
                check_result(Path(place), overwrite=overwrite or continued, source=source, made=self.output)

    def position(self) -> int | None:
        """Return `seq` of the last frame that the log holds whole, 0 for none; None if there is to be no log."""
        log = self._log()
        return None if log is None else max((frame.number + 1 for frame, _ in whole_frames(log)), default=0)

    def make_folder(self) -> None:
        """Make the folder of the results, in which other files of the run may be, too."""
        if self.output is not None:
            with writing(self.output, VideoError):
                self.output.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def opened(self, endpoint: str, *, resume: bool = False) -> Iterator[Callable[[TrackedFrame], None]]:
        """Yield a function that writes a frame everywhere; at the end, everything is closed.

        If `resume`, the files continue after `position`; otherwise existing ones are replaced. The function and the end
        raise VideoError if a destination cannot be written any more.
        """
        log = self._log() if resume else None  # before new ones exist, too
        last = max((frame.number for frame, _ in whole_frames(log)), default=-1) if log is not None else -1
        origin = replace(self.origin, endpoint=endpoint, last=last)
        with ExitStack() as stack:
            sinks = [stack.enter_context(closing(open_sink(place, origin))) for place in self.places]
            behind = [(sink, sink.last) for sink in sinks if hasattr(sink, "last") and sink.last < last]
            for frame, _ in read_frames(log) if log is not None and behind else ():
                for sink, its_last in behind:
                    if its_last < frame.number:
                        sink.write(frame)

            def write(frame: TrackedFrame) -> None:
                for sink in sinks:
                    sink.write(frame)

            yield write

    def _log(self) -> Path | None:
        """Return the log that is continued, None if there is to be none."""
        logs = (Path(place) for place in self.places if is_log(Path(place)))
        return min(logs, key=lambda log: (not log.exists(), LOGS.index(log.suffix)), default=None)
