"""Tracks the objects of many videos, each video in one process, from a table of boxes.

An object with one box is tracked from its frame to the end of the video. An object with boxes in several
frames is annotated: `catstream.annotate` tracks between them, and checks the frames.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

from msgspec import convert

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.base.tables import Row, read_table, write_table
from catstream.base.text import listed
from catstream.base.threads import one_thread
from catstream.base.workers import run_tasks
from catstream.errors import BoxError, CatstreamError, ServiceError, VideoError
from catstream.multi import MultiTracker
from catstream.offline.annotation import Annotation
from catstream.offline.keyframes import Keyframe, KeyframeBox, by_object, format_keyframe, parse_row
from catstream.output.destinations import Header, Origin, TrackedFrame
from catstream.output.track_log import Log, RunFiles, destinations_of
from catstream.processes.job import Results
from catstream.video.source import open_source
from catstream.wire.messages import Track

#: Name of the table of results in the folder of a batch.
SUMMARIES = "batch.csv"


class Video(NamedTuple):
    """A video of a batch.

    file       its path as in the table
    path       its absolute path
    name       of its results: `file` without its suffix, with _ for each separator
    keyframes  boxes of each object, by name and frame
    """

    file: str
    path: Path
    name: str
    keyframes: Mapping[str, Mapping[int, KeyframeBox]]

    @property
    def boxes(self) -> str:
        """All boxes in one line."""
        drawn = ((name, frame, box) for name, boxes in self.keyframes.items() for frame, box in boxes.items())
        return " ".join(format_keyframe(*keyframe) for keyframe in drawn)


@dataclass(frozen=True, slots=True)
class Summary:
    """A row of batch.csv: the result of a video.

    objects   number of objects
    frames    number of frames with a track
    tracks    number of tracks: one for each object and frame
    present   tracks with a box
    doubtful  tracks that need a check by eye
    checked   tracks that are keyframes or checked
    error     reason why the video was not tracked to its end; empty if it was
    boxes     `Video.boxes`
    """

    video: str
    objects: int = 0
    frames: int = 0
    tracks: int = 0
    present: int = 0
    doubtful: int = 0
    checked: int = 0
    error: str = ""
    boxes: str = ""

    def add(self, tracks: Sequence[Track]) -> Summary:
        """Return the summary with the tracks of a frame."""
        return replace(
            self,
            frames=self.frames + 1,
            tracks=self.tracks + len(tracks),
            present=self.present + sum(track.box is not None for track in tracks),
            doubtful=self.doubtful + sum(track.doubtful for track in tracks),
            checked=self.checked + sum(track.checked in ("keyframe", "checked") for track in tracks),
        )


_COLUMNS = tuple(field.name for field in fields(Summary))


def read_videos(table: Path) -> list[Video]:
    """Read the videos of a table with the columns file, object, x, y, w, h, and optionally frame.

    A path is relative to the folder of the table. The default of frame is 0. An object may have an empty name, and x
    may be `absent`. Raises VideoError if the table cannot be read, a column is missing, a value is invalid, or two
    videos have the same name; BoxError if an object has two boxes in one frame.
    """
    boxes: dict[str, list[Keyframe]] = {}

    def parse(row: Row) -> tuple[str, Keyframe]:
        if not (file := row.text("file")):
            raise ValueError("column file: expected the path of a video")
        return str(Path(file)), parse_row(row, frame=0)

    for file, keyframe in read_table(table, ("file", "object", "x", "y", "w", "h"), parse):
        boxes.setdefault(file, []).append(keyframe)
    videos = []
    for file, keyframes in boxes.items():
        path = (table.parent / file).absolute()
        stem = Path(file) if path.is_dir() else Path(file).with_suffix("")
        name = "_".join(part for part in stem.parts if part not in ("/", "..", "."))
        try:
            videos.append(Video(file, path, name, by_object(keyframes)))
        except BoxError as error:
            raise BoxError(f"{file}: {error}") from None
    names = [video.name for video in videos]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise VideoError(f"several videos would have the results {listed(twice)}: rename their files")
    return videos


def check_results(videos: Iterable[Video], output: Path) -> None:
    """Raise VideoError if a folder has results of other videos, or of another command."""
    for video in videos:
        log = output / f"{video.name}.ndjson"
        if not (output / SUMMARIES).exists():
            _files(video, output, overwrite=False)
        elif log.exists() and log.stat().st_size:  # a video with an empty log is tracked again
            source = (Log(log).header() or Header()).source
            if os.path.realpath(source) != os.path.realpath(video.path):
                raise VideoError(
                    f"{log} is the log of {source or 'another run'}, not of {video.path}: pass another --output, or "
                    "--overwrite to replace it"
                )


class Batch:
    """The videos of a batch, and the table batch.csv in the folder of the results.

    rows  the rows by video, including the rows of other tables, without videos that have to be tracked again
    """

    def __init__(self, videos: Sequence[Video], output: Path, *, overwrite: bool) -> None:
        self.videos, self._output, self._table = videos, output, output / SUMMARIES
        self.rows = {row.video: row for row in read_summaries(self._table) if not row.error}
        for video in videos:
            files, row = _files(video, output, overwrite=True), self.rows.get(video.file)
            is_missing = any(not Path(dest).exists() or not Path(dest).stat().st_size for dest in files.destinations)
            if row is not None and (overwrite or is_missing or row.boxes != video.boxes):
                del self.rows[video.file]
        self._write()

    @property
    def missing(self) -> list[Video]:
        """The videos that remain to be tracked."""
        return [video for video in self.videos if video.file not in self.rows]

    def track(self, settings: Settings, jobs: int) -> Generator[Summary]:
        """Track the missing videos in `jobs` processes, and yield the row of each one after it was written.

        If a process is killed, for example because memory is exhausted, the remaining videos are tracked one by one.
        """
        try:
            yield from self._track(self.missing, settings, jobs)
        except ServiceError:
            for video in self.missing:
                try:
                    yield from self._track([video], settings, 1)
                except ServiceError as error:
                    yield self._add(Summary(video.file, len(video.keyframes), error=str(error), boxes=video.boxes))

    def _track(self, videos: Iterable[Video], settings: Settings, jobs: int) -> Iterator[Summary]:
        for row in run_tasks(track_video, [(video, self._output, settings) for video in videos], jobs):
            yield self._add(row)

    def _add(self, row: Summary) -> Summary:
        self.rows[row.video] = row
        self._write()
        return row

    def _write(self) -> None:
        rows = sorted(self.rows.values(), key=lambda row: row.video)
        write_table(self._table, _COLUMNS, map(astuple, rows), VideoError)


def track_video(video: Video, output: Path, settings: Settings) -> Summary:
    """Track the objects of a video, and write their tracks to NAME.ndjson and NAME.csv in `output`.

    An error is in the summary; the tracks up to it are in the files. Existing files are replaced.
    """
    summary = Summary(video.file, len(video.keyframes), boxes=video.boxes)
    try:
        with one_thread(opencv=True), ExitStack() as stack:
            header, frames = _frames(video, settings, stack)
            files = _files(video, output, header, overwrite=True)
            output_files = stack.enter_context(files.opened(""))
            for frame in frames:
                output_files.write(frame)
                summary = summary.add(frame.tracks)
    except CatstreamError as error:
        return replace(summary, error=str(error))
    return summary


def read_summaries(path: Path) -> list[Summary]:
    """Read the rows of batch.csv; empty if it does not exist, VideoError if it is another table."""
    if not path.exists():
        return []
    try:
        return read_table(path, _COLUMNS, lambda row: convert(row.values, Summary, strict=False))
    except VideoError as error:
        raise VideoError(f"{path} is not the table of a batch ({error}): pass another --output") from None


def _files(video: Video, output: Path, header: Header | None = None, *, overwrite: bool) -> RunFiles:
    """The files of a video; VideoError if they exist, unless `overwrite`, or cannot be written."""
    origin = Origin(header or Header(source=str(video.path)))
    files = RunFiles(origin, output, destinations_of(video.name, Results(output=output)))
    files.check(overwrite=overwrite, earlier=[])
    return files


def _frames(video: Video, settings: Settings, stack: ExitStack) -> tuple[Header, Iterator[TrackedFrame]]:
    """The tracks of all objects of a video, frame by frame."""
    several = {name: boxes for name, boxes in video.keyframes.items() if len(boxes) > 1}
    single = {name: boxes for name, boxes in video.keyframes.items() if len(boxes) == 1}
    if not several:
        return _tracked(video.path, single, settings, stack)

    # Step 1: track between the boxes of objects with several.
    annotation = stack.enter_context(Annotation(str(video.path), several, settings, jobs=1))
    annotation.track()
    frames = annotation.frames
    changed = tuple(annotation.settings.changed())
    header = Header(source=str(video.path), size=frames.size, rate=frames.rate, frames=len(frames), settings=changed)

    # Step 2: add the other objects, whose run begins at the frame of the first box.
    def merged() -> Iterator[TrackedFrame]:
        part, others = _tracked(video.path, single, settings, stack) if single else (Header(), iter(()))
        for number, tracks in enumerate(zip(*annotation.tracks.values(), strict=True)):
            added = next(others, TrackedFrame([])).tracks if number >= part.start else ()
            shifted = (replace(track, frame=number, began=track.began + part.start) for track in added)
            yield TrackedFrame([*tracks, *shifted])
        next(others, None)  # raises the error of a box after the last frame

    return header, merged()


def _tracked(
    path: Path, keyframes: Mapping[str, Mapping[int, KeyframeBox]], settings: Settings, stack: ExitStack
) -> tuple[Header, Iterator[TrackedFrame]]:
    """Track objects, each from its only box on, with the same tracks as `catstream track` in lockstep."""
    begins: dict[int, dict[str, Box]] = {}
    for name, boxes in keyframes.items():
        for frame, box in boxes.items():
            if not isinstance(box, Box):
                raise BoxError(f"{name or 'the object'} has no box: pass its box in at least one frame")
            begins.setdefault(frame, {})[name] = box
    first = min(begins, default=0)
    source = stack.enter_context(open_source(str(path), part=slice(first, None), settings=settings.run))
    settings = settings.for_length(source.frames)
    header = Header(
        source=str(path),
        size=source.size,
        rate=source.rate,
        frames=source.frames,
        start=first,
        settings=tuple(settings.changed()),
        boxes=begins.get(first, {}),
    )

    def frames() -> Iterator[TrackedFrame]:
        tracker = MultiTracker(settings)
        for frame in source:
            begin = begins.pop(number := frame.number + first, {})
            if frame.number == 0:
                tracker.init(frame.image, begin, frame.time)
            else:
                tracker.update(frame.image, time=frame.time, begin=begin)
            yield TrackedFrame([replace(track, source_frame=number) for track in tracker.tracks.values()])
        for frame_number, boxes in begins.items():
            raise BoxError(
                f"{listed(boxes)}: frame {frame_number} is outside the video: pass a frame from 0 to {number}"
            )

    return header, frames()
