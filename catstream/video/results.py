"""Results of a run as text files with one row for each frame. Each row is flushed as it is written.

    NAME.txt               x,y,w,h in pixels; nan,nan,nan,nan if the object is absent
    NAME_confidence.value  the score
    NAME_time.txt          processing time of the frame in seconds
    NAME.csv               frame, seconds since the start of the source, state, x, y, w, h, score, model_version

The toolkits of the public benchmarks read the first three. Two lockstep runs
write the same NAME.txt, NAME_confidence.value and NAME.csv, byte for byte;
NAME_time.txt is measured and differs between runs.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Self, get_args

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages import State, Track

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

#: Header of NAME.csv.
COLUMNS = "frame,seconds,state,x,y,w,h,score,model_version"

_ABSENT = "nan,nan,nan,nan"


def table_file(name: str) -> str:
    """Return the name of the CSV file, which has one row for each track."""
    return f"{name}.csv"


def result_files(name: str) -> tuple[str, ...]:
    """Return the names of all results files of a run."""
    return (*_row_files(name), table_file(name))


def format_row(track: Track) -> str:
    """Return the row of a track in NAME.csv."""
    box = ",,," if track.box is None else _sides(track.box)
    return f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version}"


def parse_row(text: str) -> Track:
    """Return the track of a row of NAME.csv. Raises ValueError if it is not such a row."""
    frame, seconds, state, x, y, w, h, score, version = text.split(",")
    box = Box(*map(float, (x, y, w, h))) if x else None
    return Track(int(frame) + 1, int(frame), float(seconds), _state(state), box, float(score), int(version))


def _sides(box: Box) -> str:
    return ",".join(f"{value:.4f}" for value in box)


class ResultsWriter:
    """Writes the results files of one run; a context manager.

    Row k belongs to frame `start + k` of the source. A frame without a track (a live source skipped it) gets a row of
    nan.

    Parameters
    ----------
    directory : folder of the results; it is made if it does not exist
    name : name of the run, usually that of the source
    start : number of the first frame
    keep : append to the existing files after the frames before `keep` that are complete in every file; None replaces
        the files

    Raises
    ------
    VideoError
        From the constructor if the folder cannot be written to; later if a write fails.
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
                "give a folder that exists or can be made, and that you have permission to write to"
            ) from None

    def write(self, track: Track, seconds: float) -> None:
        """Add the track of one frame and its processing time. A frame that already has a row is skipped."""
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
        """Close the files."""
        with self._reporting_errors():  # closing retries a row whose write failed
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
    """Yield the tracks in `NAME.csv` up to the first incomplete row; none if there is no file."""
    for _, track in _parsed_lines(directory / table_file(name)):
        yield track


def complete_frames(directory: Path, name: str) -> int:
    """Return the number of frames that are complete in every file."""
    least = min(len(_row_ends(directory / file)) - 1 for file in _row_files(name))
    return max((track.frame + 1 for track in read_tracks(directory, name) if track.frame < least), default=0)


def _row_files(name: str) -> tuple[str, ...]:
    """Return the names of the files that have a row for every frame, with or without a track."""
    return f"{name}.txt", f"{name}_confidence.value", f"{name}_time.txt"


def _parsed_lines(path: Path) -> Iterator[tuple[int, Track]]:
    """Yield each track of `NAME.csv` with the byte offset at which its line ends."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        end = len(file.readline())
        for line in file:
            try:
                track = parse_row(line.decode("ascii"))
            except ValueError:  # an incomplete line, or a block that was never written before a power cut
                return
            if not line.endswith(b"\n"):
                return
            end += len(line)
            yield end, track


def _state(text: str) -> State:
    states: dict[str, State] = {state: state for state in get_args(State)}
    if text not in states:
        raise ValueError(text)
    return states[text]


def _row_ends(path: Path) -> list[int]:
    """Return the byte offsets at which the complete rows of a file end."""
    ends = [0]
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        for line in file:
            if not line.endswith(b"\n") or b"\0" in line:
                break
            ends.append(ends[-1] + len(line))
    return ends


def _truncate(directory: Path, name: str, keep: int) -> int:
    """Truncate all files to the same number of complete frames, at most `keep`; return that number."""
    rows = min(complete_frames(directory, name), keep)
    for file in _row_files(name):
        if (directory / file).exists():
            os.truncate(directory / file, _row_ends(directory / file)[rows])
    if (path := directory / table_file(name)).exists():
        ends = [end for end, track in _parsed_lines(path) if track.frame < rows]
        os.truncate(path, ends[-1] if ends else 0)
    return rows
