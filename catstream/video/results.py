"""Results of a run as text files: a row a frame, flushed as it is written.

    NAME.txt               x,y,w,h in pixels; nan,nan,nan,nan where the object is absent
    NAME_confidence.value  the score
    NAME_time.txt          seconds of work that the frame took
    NAME.csv               frame, seconds since the start of the source, state, x, y, w, h, score, model_version

The first three are what the benchmarks' toolkits read. Two lockstep runs write
the same NAME.txt, NAME_confidence.value and NAME.csv, byte for byte;
NAME_time.txt is measured and is never the same twice.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages import Track

__all__ = [
    "COLUMNS",
    "ResultsWriter",
    "complete_frames",
    "format_row",
    "parse_row",
    "read_tracks",
    "result_files",
    "table_file",
]

#: Of NAME.csv.
COLUMNS = "frame,seconds,state,x,y,w,h,score,model_version"

_ABSENT = "nan,nan,nan,nan"


def table_file(name: str) -> str:
    """Name of the file with a row a track."""
    return f"{name}.csv"


def result_files(name: str) -> tuple[str, ...]:
    """Names of all results files of a run."""
    return (*_row_files(name), table_file(name))


def format_row(track: Track) -> str:
    """The row of a track in NAME.csv."""
    box = ",,," if track.box is None else _sides(track.box)
    return f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version}"


def parse_row(text: str) -> Track:
    """The track of such a row; raises ValueError if it is none."""
    frame, seconds, state, x, y, w, h, score, version = text.split(",")
    box = Box(*map(float, (x, y, w, h))) if x else None
    return Track(int(frame) + 1, int(frame), float(seconds), _state(state), box, float(score), int(version))


def _sides(box: Box) -> str:
    return ",".join(f"{value:.4f}" for value in box)


class ResultsWriter:
    """Writes the results files of one run; a context manager.

    Row k is frame `start + k` of the source: frames that no track was written
    for (a live source skipped them) get a row of nan.

    Parameters
    ----------
    directory : where to write; made if it is not there
    name : of the run, usually that of the source
    start : number of the first frame
    keep : go on with the files that are there, after their rows of frames before this one that are whole in every
        file; None to replace them

    Raises
    ------
    VideoError
        Where the directory cannot be written to, before any work is done; or takes no more, later.
    """

    def __init__(self, directory: str | Path, name: str, start: int = 0, *, keep: int | None = None) -> None:
        self.directory = Path(directory)
        self.rows = start
        try:
            with contextlib.ExitStack() as stack:
                self.directory.mkdir(parents=True, exist_ok=True)
                if keep is not None:
                    self.rows = _truncate(self.directory, name, keep)
                self._boxes, self._scores, self._times, self._tracks = (
                    stack.enter_context(
                        (self.directory / file).open("w" if keep is None else "a", encoding="ascii", buffering=1)
                    )
                    for file in result_files(name)
                )
                if not self._tracks.tell():
                    self._tracks.write(COLUMNS + "\n")
                self._files = stack.pop_all()
        except OSError as error:
            raise VideoError(
                f"cannot write results to {str(directory)!r} ({error.strerror}): "
                "give a folder that exists or can be made, and that you may write to"
            ) from None

    def write(self, track: Track, seconds: float) -> None:
        """Add one frame, and the seconds of work it took. A frame that has its row already is skipped."""
        if track.frame < self.rows:
            return
        with self._reporting_errors():
            for _ in range(track.frame - self.rows):
                self._row(_ABSENT, "nan", "nan")
            self._row(_ABSENT if track.box is None else _sides(track.box), f"{track.score:.6f}", f"{seconds:.6f}")
            self._tracks.write(format_row(track) + "\n")
        self.rows = track.frame + 1

    def _row(self, box: str, score: str, seconds: str) -> None:
        for file, text in ((self._boxes, box), (self._scores, score), (self._times, seconds)):
            file.write(text + "\n")

    def close(self) -> None:
        """Close the files; what was written stays."""
        with self._reporting_errors():  # where a row was not taken, it is tried once more
            self._files.close()

    @contextlib.contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise VideoError(f"cannot write results to {str(self.directory)!r} any more: {error.strerror}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_tracks(directory: Path, name: str) -> Iterator[Track]:
    """The tracks that `NAME.csv` holds, up to the first that is not whole; none where there is no file."""
    for _, track in _parsed_lines(directory / table_file(name)):
        yield track


def complete_frames(directory: Path, name: str) -> int:
    """How many frames are whole in every file."""
    least = min(len(_row_ends(directory / file)) - 1 for file in _row_files(name))
    return max((track.frame + 1 for track in read_tracks(directory, name) if track.frame < least), default=0)


def _row_files(name: str) -> tuple[str, ...]:
    """Files with a row a frame, also of one that no track was written for."""
    return f"{name}.txt", f"{name}_confidence.value", f"{name}_time.txt"


def _parsed_lines(path: Path) -> Iterator[tuple[int, Track]]:
    """Where each line of `NAME.csv` ends, in bytes, and its track."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        end = len(file.readline())
        for line in file:
            try:
                track = parse_row(line.decode("ascii"))
            except ValueError:  # half a line, or what a disk holds where nothing was written yet
                return
            if not line.endswith(b"\n"):
                return
            end += len(line)
            yield end, track


def _state(text: str) -> Any:
    if text not in ("bootstrapping", "present", "absent"):
        raise ValueError(text)
    return text


def _row_ends(path: Path) -> list[int]:
    """Where each whole row of a file ends, in bytes."""
    ends = [0]
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        for line in file:
            if not line.endswith(b"\n") or b"\0" in line:
                break
            ends.append(ends[-1] + len(line))
    return ends


def _truncate(directory: Path, name: str, keep: int) -> int:
    """Keep so many frames, if so many are whole in every file, and cut off the others; returns how many are kept."""
    rows = min(complete_frames(directory, name), keep)
    for file in _row_files(name):
        if (directory / file).exists():
            os.truncate(directory / file, _row_ends(directory / file)[rows])
    if (path := directory / table_file(name)).exists():
        ends = [end for end, track in _parsed_lines(path) if track.frame < rows]
        os.truncate(path, ends[-1] if ends else 0)
    return rows
