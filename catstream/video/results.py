"""Results of a run as text files, each row flushed as it is written.

    NAME.txt               x,y,w,h in pixels of each frame; nan,nan,nan,nan if the object is absent
    NAME_confidence.value  the score of each frame
    NAME_time.txt          processing time of each frame in seconds
    NAME.csv               a row for each object and frame: frame, seconds since the start of the source, state,
                           x, y, w, h, score, model_version, object

The toolkits of the public benchmarks read the first three. They are of one object: an object with a name has its own,
NAME-OBJECT.txt, NAME-OBJECT_confidence.value and NAME-OBJECT_time.value. Two lockstep runs write the same files, byte
for byte, except for the measured times.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from glob import escape
from pathlib import Path
from typing import IO, Self, get_args

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import State, Track
from catstream.messages.names import UNNAMED, check_name, is_name
from catstream.messages.storage import name_fits

__all__ = [
    "COLUMNS",
    "ResultsWriter",
    "complete_rows",
    "format_row",
    "object_files",
    "objects_of",
    "parse_row",
    "read_tracks",
    "result_files",
    "table_file",
]

_log = logging.getLogger(__name__)

#: Header of NAME.csv.
COLUMNS = "frame,seconds,state,x,y,w,h,score,model_version,object"

#: The row of a frame without a track in each of the files of an object.
_NOTHING = ("nan,nan,nan,nan", "nan", "nan")


def table_file(name: str) -> str:
    """Return the name of the CSV file, which has one row for each track."""
    return f"{name}.csv"


def object_files(name: str, thing: str) -> tuple[str, ...]:
    """Return the names of the files of one object, which have a row for every frame."""
    if not thing:
        return f"{name}.txt", f"{name}_confidence.value", f"{name}_time.txt"
    # No name of another object gives one of these: `a_time` has the boxes a_time.txt, and `a` the times a_time.value.
    return f"{name}-{thing}.txt", f"{name}-{thing}_confidence.value", f"{name}-{thing}_time.value"


def objects_of(directory: Path, name: str) -> set[str]:
    """Return the names of the objects of a source that have files in a folder, also those left of an earlier run."""
    found = (path.stem.removeprefix(f"{name}-") for path in directory.glob(f"{escape(name)}-*.txt"))
    # With a table of its own it is no object, but a source of such a name.
    return {
        thing
        for thing in found
        if is_name(thing)
        and not _is_taken(directory, name, thing)
        and not (directory / table_file(f"{name}-{thing}")).exists()
    }


def _is_taken(directory: Path, name: str, thing: str) -> bool:
    """Whether a file of something else has the name of an object's boxes: their own come after those of the scores."""
    boxes, scores, _ = (directory / file for file in object_files(name, thing))
    return thing != UNNAMED and boxes.exists() and not scores.exists()


def _fits(directory: Path, name: str, thing: str) -> bool:
    """Whether the names of an object's files are not too long for the file system."""
    return all(name_fits(directory / file) for file in object_files(name, thing))


def result_files(name: str, objects: Sequence[str]) -> tuple[str, ...]:
    """Return the names of all results files of a run."""
    return (*(file for thing in objects for file in object_files(name, thing)), table_file(name))


def format_row(track: Track) -> str:
    """Return the row of a track in NAME.csv."""
    box = ",,," if track.box is None else _sides(track.box)
    return f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version},{track.object}"


def parse_row(text: str) -> Track:
    """Return the track of a row of NAME.csv. Raises ValueError if it is not such a row."""
    frame, seconds, state, x, y, w, h, score, version, thing = text.removesuffix("\n").split(",")
    box = Box(*map(float, (x, y, w, h))) if x else None
    number = int(frame)
    name = check_name(thing)
    return Track(number + 1, number, float(seconds), _state(state), box, float(score), int(version), object=name)


def _sides(box: Box) -> str:
    return ",".join(f"{value:.4f}" for value in box)


class ResultsWriter:
    """Writes the results files of one run; a context manager.

    Row k of the files of an object belongs to frame k of the source. It is nan in a frame without a track: before the
    object began, after it was forgotten, or if a live source skipped the frame.

    Parameters
    ----------
    directory : folder of the results; it is made if it does not exist
    name : name of the run, usually that of the source
    keep : continue the existing files after the frames before `keep`; None replaces the table and the files of an
        object without a name. A file of something else that has the name of an object's file is kept: the tracks of
        this object are in the table only, and a warning says so; likewise if the name would be too long for a file

    Raises
    ------
    VideoError
        From the constructor if the folder cannot be written to; later if a write fails.
    """

    def __init__(self, directory: str | Path, name: str, *, keep: int | None = None) -> None:
        self.directory, self.name = Path(directory), name
        self.rows = 0
        self._continues = keep is not None
        self._objects: dict[str, list[IO[str]]] = {}  # the files of each object that has appeared
        try:
            with contextlib.ExitStack() as self._files:
                self.directory.mkdir(parents=True, exist_ok=True)
                table = self.directory / table_file(name)
                objects: list[str] = []
                if keep is not None:
                    self.rows, objects = _truncate(table, keep)
                self._table = self._open(table, "w" if keep is None else "a")
                if not self._table.tell():
                    self._table.write(COLUMNS + "\n")
                for thing in objects:
                    self._begin(thing)
                self._files = self._files.pop_all()
        except OSError as error:
            raise VideoError(
                f"cannot write results to {str(directory)!r} ({error.strerror}): "
                "give a folder that exists or can be made, and that you have permission to write to"
            ) from None

    def write(self, tracks: Sequence[Track], seconds: float) -> None:
        """Add the tracks of one frame and its processing time. A frame that already has a row is skipped."""
        frame = tracks[0].frame
        if frame < self.rows:
            return
        found = {track.object: track for track in tracks}
        with self._reporting_errors():
            for thing in found:
                if thing not in self._objects:
                    self._begin(thing)
            for thing, files in self._objects.items():
                if not files:
                    continue
                row = _row(found[thing], seconds) if thing in found else _NOTHING
                for file, text, nothing in zip(files, row, _NOTHING, strict=True):
                    file.write((frame - self.rows) * f"{nothing}\n" + f"{text}\n")
            self._table.write("".join(format_row(track) + "\n" for track in tracks))
        self.rows = frame + 1

    def close(self) -> None:
        """Close the files."""
        with self._reporting_errors():  # closing retries a row whose write failed
            self._files.close()

    def _begin(self, thing: str) -> None:
        """Open the files of an object, with a row for each frame so far."""
        files: list[IO[str]] = []
        paths = [self.directory / file for file in object_files(self.name, thing)]
        fits = _fits(self.directory, self.name, thing)
        taken = _is_taken(self.directory, self.name, thing) or (thing and not self._continues and paths[0].exists())
        if taken or not fits:
            reason = "exists already and is kept" if fits else "would be too long a name"
            _log.warning("%s %s: the boxes of %s are in %s only", paths[0], reason, thing, table_file(self.name))
            self._objects[thing] = []
            return
        for path, nothing in reversed([*zip(paths, _NOTHING, strict=True)]):
            ends = _row_ends(path)[: self.rows + 1] if self._continues else [0]
            if self._continues and path.exists():
                os.truncate(path, ends[-1])
            files.insert(0, self._open(path, "a" if self._continues else "w"))
            files[0].write((self.rows + 1 - len(ends)) * f"{nothing}\n")
        self._objects[thing] = files

    def _open(self, path: Path, mode: str) -> IO[str]:
        return self._files.enter_context(path.open(mode, encoding="utf-8", buffering=1))

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


def complete_rows(directory: Path, name: str, thing: str) -> int:
    """Return the number of rows that are complete in every file of an object; infinitely many if it has no files."""
    if _is_taken(directory, name, thing) or not _fits(directory, name, thing):
        return sys.maxsize
    return min(len(_row_ends(directory / file)) - 1 for file in object_files(name, thing))


def _row(track: Track, seconds: float) -> tuple[str, str, str]:
    """Return the row of a track in each of the files of its object."""
    box = _NOTHING[0] if track.box is None else _sides(track.box)
    return box, f"{track.score:.6f}", f"{seconds:.6f}"


def _parsed_lines(path: Path) -> Iterator[tuple[int, Track]]:
    """Yield each track of `NAME.csv` with the byte offset at which its line ends."""
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:
        end = len(file.readline())
        for line in file:
            try:
                track = parse_row(line.decode())
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


def _truncate(table: Path, keep: int) -> tuple[int, list[str]]:
    """Truncate `NAME.csv` to the frames before `keep`; return their number, and the names of their objects."""
    end, rows, objects = 0, 0, dict[str, None]()
    for end_of_line, track in _parsed_lines(table):
        if track.frame < keep:
            end, rows = end_of_line, track.frame + 1
            objects[track.object] = None
    if table.exists():
        os.truncate(table, end)
    return rows, list(objects)
