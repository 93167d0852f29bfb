"""All files to which a run writes its tracks, from its start or from the frame at which it was interrupted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages import ObjectPosition, Position, Track
from catstream.sinks.sink import STDOUT, Sink, check_writable, discard, file_exists, is_closed, open_sink, reader
from catstream.storage import is_writable
from catstream.video import results
from catstream.video.frames import RATE
from catstream.video.results import ResultsWriter

__all__ = ["RunFiles"]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """The files to which a run writes its tracks.

    A resumed run continues after the last frame that all files hold. Rows after it, which a power cut left in some of
    the files, are removed. New files, and formats that do not hold all tracks (video, MOT text), start at the first
    frame again, with the tracks from another file.

    name    of the results files: that of the source
    source  of the frames of a video
    part    the frames of the source that are followed
    output  folder of the results files; None for no results
    video   whether the results include a video
    files   further files for tracks, see `catstream.sinks.sink`
    rate    frames per second of a folder of images
    """

    name: str
    source: str
    part: slice
    output: Path | None = None
    video: bool = False
    files: Sequence[Path] = ()
    rate: float = RATE

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
        existing = [file.name for file in self._results() if file.exists()]
        if existing and not overwrite and self.output not in known:
            raise VideoError(
                f"results of {self.name!r} are in {str(self.output)!r} already ({', '.join(existing)}): "
                "replace them all with --overwrite, or give another folder"
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
        frames = min((count for count, _ in earlier), default=0)
        found = {
            track.object: ObjectPosition(track.box) for track in self._tracks(earlier, frames) if track.box is not None
        }
        return Position(frames, max(frames - 1, 0), found)

    @contextmanager
    def opened(self, *, resume: bool = False) -> Iterator[Callable[[Track, float], None]]:
        """Yield a function that writes a track, and the seconds that it took, to all files; then close the files.

        Parameters
        ----------
        resume : whether to continue the files after `position`; otherwise existing files are replaced

        Raises
        ------
        VideoError
            If a file cannot be written; also later, from the function and at the end.
        """
        earlier = self._earlier() if resume else []
        keep = min((count for count, _ in earlier), default=0) if resume else None
        rows: list[ResultsWriter] = []
        sinks: list[Sink] = []
        restarted: list[Callable[[Track], None]] = []  # write to the files that start at the first frame again
        with ExitStack() as stack:
            if self.output is not None:
                new = not (self.output / results.table_file(self.name)).exists()
                discard(self._video_file())
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
            for track in self._tracks(earlier, keep or 0) if restarted else ():
                for write_again in restarted:
                    write_again(track)

            def write(track: Track, seconds: float) -> None:
                for writer in rows:
                    writer.write(track, seconds)
                for sink in sinks:
                    sink.write(track)

            yield write

    def _results(self) -> list[Path]:
        """Return the results files, including the video."""
        if self.output is None:
            return []
        return [*(self.output / file for file in results.result_files(self.name)), self._video_file()]

    def _video_file(self) -> Path:
        return (self.output or Path()) / f"{self.name}.mp4"

    def _earlier(self) -> list[tuple[int, Callable[[], Iterator[Track]]]]:
        """Return the number of frames in each existing file that holds all tracks, and the function that reads them."""
        found: list[tuple[int, Callable[[], Iterator[Track]]]] = []
        if self.output is not None and (self.output / results.table_file(self.name)).exists():
            count = results.complete_frames(self.output, self.name)
            found.append((count, partial(results.read_tracks, self.output, self.name)))
        for file in self.files:
            read = reader(file)
            if read is not None and file_exists(file):
                found.append((max((track.frame + 1 for track in read(file)), default=0), partial(read, file)))
        return found

    @staticmethod
    def _tracks(earlier: list[tuple[int, Callable[[], Iterator[Track]]]], frames: int) -> Iterator[Track]:
        """Yield the tracks of the earlier part of the run."""
        read = earlier[0][1] if earlier else lambda: iter(())
        return takewhile(lambda track: track.frame < frames, read())
