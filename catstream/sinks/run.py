"""All files to which a run writes its tracks, from its start or from the frame at which it was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import ObjectPosition, Position, Track
from catstream.messages.names import UNNAMED
from catstream.messages.storage import is_writable, name_fits
from catstream.sinks.frames import FIRST, by_frame, in_order, objects_of, whole_frames
from catstream.sinks.sink import STDOUT, Sink, check_writable, discard, file_exists, is_closed, open_sink, reader
from catstream.video import results
from catstream.video.frames import RATE
from catstream.video.results import ResultsWriter

__all__ = ["RunFiles"]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """The files to which a run writes its tracks.

    A resumed run continues after the last frame that all files hold whole, see `catstream.sinks.frames`. Rows after it,
    which a power cut left in some of the files, are removed. New files, and formats that do not hold all tracks (video,
    MOT text), start at the first frame again, with the tracks from another file.

    name    of the results files: that of the source
    source  of the frames of a video
    part    the frames of the source that are followed
    output  folder of the results files; None for no results
    video   whether the results include a video
    files   further files for tracks, see `catstream.sinks.sink`
    rate    frames per second of a folder of images
    objects names of the objects in the first frame, as far as they are known before it
    """

    name: str
    source: str
    part: slice
    output: Path | None = None
    video: bool = False
    files: Sequence[Path] = ()
    rate: float = RATE
    objects: Sequence[str] = ()

    def check_writable(self, *, overwrite: bool, resumable: bool, known: Sequence[Path] = ()) -> None:
        """Raise VideoError if one of the files cannot be written; to be called before the run starts.

        Parameters
        ----------
        overwrite : whether existing files may be replaced
        resumable : whether the run can be resumed later
        known : files, and a folder of results, that an earlier part of this run has written
        """
        if self.output is not None:
            folder = self.output.absolute()
            nearest = next(path for path in (folder, *folder.parents) if path.exists())
            if not is_writable(nearest):
                raise VideoError(
                    f"cannot write results to {str(self.output)!r}: give a folder that exists or can be made, "
                    "and that you may write to"
                )
            if long := [file.name for file in self._results() if not name_fits(nearest / file.name)]:
                raise VideoError(
                    f"the names of results of {self.name!r} would be too long for a file ({long[0]!r}): "
                    "give the source or the object a shorter name, or write to one file (--write FILE)"
                )
        existing = [file.name for file in self._results() if file.exists()]
        if existing and not overwrite and self.output not in known:
            raise VideoError(
                f"results of {self.name!r} are in {str(self.output)!r} already ({', '.join(existing)}), of this source "
                "or of another of that name: replace them all with --overwrite, or give another folder"
            )
        for count, file in enumerate(self.files):
            if file in self.files[:count]:
                raise VideoError(f"{file} is named twice: give each file once")
            check_writable(file, may_exist=True)
            if file_exists(file) and not overwrite and file not in known:
                raise VideoError(f"{file} exists already: replace it with --overwrite, or give another name")
        files = [file for file in self.files if file != STDOUT]
        if resumable and self.output is None and files and not any(map(reader, files)):
            raise VideoError(
                f"{files[0]} does not hold all tracks, so the run could not be resumed: add a file that does, "
                "--write tracks.ndjson or --output FOLDER"
            )

    @property
    def complete(self) -> bool:
        """Whether all files exist and are complete."""
        files = [file for file in self.files if file != STDOUT]
        return all(is_closed(file) for file in [*files, *([self._video_file()] if self.video else [])])

    def position(self) -> Position | None:
        """Return the position of the last frame that all files hold; None if no file holds tracks."""
        if self.output is None and not any(map(reader, self.files)):
            return None
        earlier = self._earlier()
        frames = _common(earlier)
        boxes: dict[str, Box | None] = {}
        objects: list[str] = []
        for tracks in _frames(earlier):
            objects = [track.object for track in tracks]
            boxes |= {track.object: track.box for track in tracks if track.box is not None}
        return Position(frames, max(frames - 1, 0), {name: ObjectPosition(boxes.get(name)) for name in objects})

    def names(self) -> list[str]:
        """Return the names of the objects in the files, in the order in which they appeared."""
        return list(dict.fromkeys(track.object for tracks in _frames(self._earlier()) for track in tracks))

    @contextmanager
    def opened(self, *, resume: bool = False) -> Iterator[Callable[[Mapping[str, Track], float], None]]:
        """Yield a function that writes the tracks of a frame, and the seconds that it took, to all files; then close
        the files.

        Parameters
        ----------
        resume : whether to continue the files after `position`; otherwise existing files are replaced

        Raises
        ------
        VideoError
            If a file cannot be written; also later, from the function and at the end.
        """
        earlier = self._earlier() if resume else []
        keep = _common(earlier) if resume else None
        rows: list[ResultsWriter] = []
        sinks: list[Sink] = []
        restarted: list[Callable[[Sequence[Track]], None]] = []  # write to the files that start at frame 0 again
        with ExitStack() as stack:
            if self.output is not None:
                new = not (self.output / results.table_file(self.name)).exists()
                discard(self._video_file())
                if not resume:
                    self._discard_objects(self.output)
                writer = stack.enter_context(ResultsWriter(self.output, self.name, keep=keep))
                rows.append(writer)
                restarted += [partial(writer.write, seconds=float("nan"))] if new else []
            for file in (*self.files, *([self._video_file()] if self.video else [])):
                new = reader(file) is None or not file_exists(file)
                if not resume:
                    discard(file)
                sink = stack.enter_context(
                    closing(open_sink(file, self.source, self.part, image_rate=self.rate, keep=keep))
                )
                sinks.append(sink)
                restarted += [sink.write] if new and file != STDOUT else []
            before = FIRST
            for tracks in _frames(earlier):
                before = objects_of(tracks)
                for write_again in restarted:
                    write_again(tracks)

            def write(tracks: Mapping[str, Track], seconds: float) -> None:
                nonlocal before
                ordered = in_order(tracks, before)
                before = objects_of(ordered)
                for writer in rows:
                    writer.write(ordered, seconds)
                for sink in sinks:
                    sink.write(ordered)

            yield write

    def _results(self) -> list[Path]:
        """Return the results files, including the video."""
        if self.output is None:
            return []
        # An object that begins later finds no file of an earlier run in its place.
        left = results.objects_of(self.output, self.name) - {*self.objects}
        files = results.result_files(self.name, [*(self.objects or [UNNAMED]), *sorted(left)])
        return [*(self.output / file for file in files), self._video_file()]

    def _discard_objects(self, folder: Path) -> None:
        """Remove the files of objects that are to be replaced, and those of an earlier run."""
        earlier = {track.object for track in results.read_tracks(folder, self.name)}
        earlier |= results.objects_of(folder, self.name)
        for name in {*self.objects, *earlier} - ({UNNAMED} & {*self.objects}):  # which the writer replaces itself
            for file in results.object_files(self.name, name):
                discard(folder / file)

    def _video_file(self) -> Path:
        return (self.output or Path()) / f"{self.name}.mp4"

    def _earlier(self) -> list[_Earlier]:
        """Return the existing files that hold all tracks."""
        found: list[_Earlier] = []
        if self.output is not None and (self.output / results.table_file(self.name)).exists():
            read = partial(results.read_tracks, self.output, self.name)
            found.append(_Earlier(read, _frames_before(read, self._complete_rows(self.output, read))))
        for file in self.files:
            format_reader = reader(file)
            if format_reader is not None and file_exists(file):
                read = partial(format_reader, file)
                found.append(_Earlier(read, _frames_before(read)))
        return found

    def _complete_rows(self, folder: Path, read: Callable[[], Iterator[Track]]) -> int:
        """Return the number of frames of which the files of all objects in the table have a row."""
        first: dict[str, int] = {}
        for tracks in whole_frames(read()):
            for track in tracks:
                first.setdefault(track.object, track.frame)
        # Rows before the first frame of an object can be written again: they have no box.
        rows = [max(results.complete_rows(folder, self.name, name), frame) for name, frame in first.items()]
        return min(rows, default=0)


class _Earlier(NamedTuple):
    """A file with the tracks of the earlier part of a run.

    read    yields its tracks
    frames  number of the last whole frame that it holds, plus one
    """

    read: Callable[[], Iterator[Track]]
    frames: int


def _frames_before(read: Callable[[], Iterator[Track]], end: int = sys.maxsize) -> int:
    """Return the number of the last whole frame before `end`, plus one."""
    return max((tracks[0].frame + 1 for tracks in whole_frames(read()) if tracks[0].frame < end), default=0)


def _common(earlier: Sequence[_Earlier]) -> int:
    """Return the number of the last whole frame that all files hold, plus one."""
    return min((file.frames for file in earlier), default=0)


def _frames(earlier: Sequence[_Earlier]) -> Iterator[list[Track]]:
    """Yield the tracks of each frame that all files hold."""
    if earlier:
        end = _common(earlier)
        yield from takewhile(lambda tracks: tracks[0].frame < end, by_frame(earlier[0].read()))
