"""All files to which a run writes its tracks, from its start or from the frame at which it was interrupted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED
from catstream.messages.storage import is_writable, name_fits, nearest, writing
from catstream.sinks import results
from catstream.sinks.formats import CsvSink, StdoutSink
from catstream.sinks.frames import FIRST, in_order, objects_of, whole_frames
from catstream.sinks.results import ResultsWriter
from catstream.sinks.sink import STDOUT, Sink, check_writable, discard, exists, open_files, reader, with_logs
from catstream.video.frames import RATE


@dataclass(frozen=True, slots=True)
class RunFiles:
    """The files to which a run writes its tracks.

    A resumed run continues after the last frame that one file holds whole, see `catstream.sinks.frames`: an NDJSON file
    if there is one, else the table of the results or a CSV file. All files are written again with the tracks of this
    file, and take the place of the earlier ones when they have them all. So it does not matter where a crash has cut
    the others, and a file or a format may be new.

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
            if not is_writable(nearest(self.output)):
                raise VideoError(
                    f"cannot write results to {str(self.output)!r}: give a folder that exists or can be made, "
                    "and that you may write to"
                )
            if long := [file.name for file in self._results() if not name_fits(file)]:
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
        self.check_source_kept([*with_logs(self.files), *([self._video_file()] if self.video else [])])
        own = [file for file in self._results() if self.video or file != self._video_file()]
        places = [file.parent.resolve() / file.name for file in [*own, *self.files]]
        if twice := [file for file in self.files if places.count(file.parent.resolve() / file.name) > 1]:
            raise VideoError(f"{twice[0]} is named twice, or is a file of the results: give each file once")
        for file in with_logs(self.files):
            check_writable(file, may_exist=True, made=self.output)
            if exists(file) and not overwrite and file not in with_logs(known):
                raise VideoError(f"{file} exists already: replace it with --overwrite, or give another name")
        files = [file for file in self.files if file != STDOUT]
        if resumable and files and not self._logs():
            raise VideoError(
                f"{files[0]} does not hold all tracks, so the run could not be resumed: add a file that does, "
                "--write tracks.ndjson or --output FOLDER"
            )

    def check_source_kept(self, files: Iterable[Path]) -> None:
        """Raise VideoError if a file to be written is the one that the frames are read from."""
        for file in filter(self._is_source, files):
            raise VideoError(f"{file} is the source, which would be lost: give another name or folder")

    def make_folder(self) -> None:
        """Make the folder of the results, in which other files of the run may be, too."""
        if self.output is not None:
            with writing(self.output, VideoError):
                self.output.mkdir(parents=True, exist_ok=True)

    def position(self) -> int | None:
        """Return `seq` of the last frame that the files hold; None if no file holds all tracks."""
        if not self._logs():
            return None
        return max((tracks[0].frame + 1 for tracks in self._earlier()), default=0)

    def names(self) -> list[str]:
        """Return the names of the objects in the files, in the order in which they appeared."""
        return list(dict.fromkeys(track.object for tracks in self._earlier() for track in tracks))

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
        for file in [] if resume else [*self._discarded(), *with_logs(self.files)]:
            discard(file)
        files = [*self.files, *([self._video_file()] if self.video else [])]
        with ExitStack() as stack:
            rows: list[ResultsWriter] = []
            if self.output is not None:
                rows.append(stack.enter_context(ResultsWriter(self.output, self.name, again=resume)))
            sinks = stack.enter_context(open_files(files, self.source, self.part, image_rate=self.rate, again=resume))

            def add(tracks: Sequence[Track], seconds: float, sinks: Sequence[Sink]) -> None:
                for writer in rows:
                    writer.write(tracks, seconds)
                for sink in sinks:
                    sink.write(tracks)

            before = FIRST
            if resume:
                repeated = [sink for sink in sinks if not isinstance(sink, StdoutSink)]
                seconds = results.read_seconds(self.output, self.name) if self.output is not None else {}
                for tracks in self._earlier():
                    add(tracks, seconds.get(tracks[0].frame, math.nan), repeated)
                    before = objects_of(tracks)
                for each in rows:
                    each.publish()
                for sink in repeated:
                    sink.publish()

            def write(tracks: Mapping[str, Track], seconds: float) -> None:
                nonlocal before
                ordered = in_order(tracks, before)
                before = objects_of(ordered)
                add(ordered, seconds, sinks)

            yield write

    def _results(self) -> list[Path]:
        """Return the results files, including the video."""
        if self.output is None:
            return []
        # An object that begins later finds no file of an earlier run in its place.
        left = results.objects_of(self.output, self.name) - {*self.objects}
        files = results.result_files(self.name, [*(self.objects or [UNNAMED]), *sorted(left)])
        return [*(self.output / file for file in files), *self._earlier_video()]

    def _discarded(self) -> list[Path]:
        """Return the results files that a new run removes: the video, and the files of objects of an earlier run."""
        if self.output is None:
            return []
        earlier = {track.object for track in CsvSink.tracks(self.output / results.table_file(self.name))}
        names = {*self.objects, *earlier, *results.objects_of(self.output, self.name)}
        names -= {UNNAMED} & {*self.objects}  # these files are replaced by those of this run
        files = [file for name in names for file in results.object_files(self.name, name)]
        return [*self._earlier_video(), *(self.output / file for file in files)]

    def _video_file(self) -> Path:
        return (self.output or Path()) / f"{self.name}.mp4"

    def _earlier_video(self) -> list[Path]:
        """Return the video of an earlier run, which may exist; the source has its name if the results are beside it."""
        return [] if self._is_source(self._video_file()) else [self._video_file()]

    def _is_source(self, file: Path) -> bool:
        return file.exists() and Path(self.source).exists() and file.samefile(self.source)

    def _logs(self) -> list[tuple[Path, Callable[[Path], Iterator[Track]]]]:
        """Return the files that hold all tracks, and the functions that read them: NDJSON first, it has all fields."""
        logs = [(file, read) for file in with_logs(self.files) if (read := reader(file)) is not None]
        table = [] if self.output is None else [(self.output / results.table_file(self.name), CsvSink.tracks)]
        return sorted([*table, *logs], key=lambda log: log[1] == CsvSink.tracks)

    def _earlier(self) -> Iterator[list[Track]]:
        """Yield the tracks of each frame that the earlier part of this run has written whole."""
        for file, read in self._logs():
            if file.exists():
                return whole_frames(read(file))
        return iter(())
