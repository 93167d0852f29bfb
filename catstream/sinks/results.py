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
import math
from collections.abc import Sequence
from glob import escape
from pathlib import Path
from typing import Self, TypeVar

from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.messages.names import UNNAMED, is_name
from catstream.messages.storage import name_fits, writing
from catstream.sinks.formats import CsvSink, format_box
from catstream.sinks.lines import LineFile

_log = logging.getLogger(__name__)
_File = TypeVar("_File", bound=LineFile)

#: The row of a frame without a track in each of the files of an object.
_NOTHING = ("nan,nan,nan,nan", "nan", "nan")


def table_file(name: str) -> str:
    """Return the name of the CSV file, which has one row for each track."""
    return f"{name}.csv"


def object_files(name: str, thing: str) -> tuple[str, str, str]:
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


def result_files(name: str, objects: Sequence[str]) -> tuple[str, ...]:
    """Return the names of all results files of a run."""
    return (*(file for thing in objects for file in object_files(name, thing)), table_file(name))


class ResultsWriter:
    """Writes the results files of one run; a context manager.

    Row k of the files of an object belongs to frame k of the source. It is nan in a frame without a track: before the
    object began, after it was forgotten, or if a live source skipped the frame.

    Parameters
    ----------
    directory : folder of the results; it is made if it does not exist
    name : name of the run, usually that of the source
    again : whether the files of an earlier part of the run are written again, see `LineFile`; otherwise, the table and
        the files of an object without a name are replaced. A file of something else that has the name of an object's
        file is kept: the tracks of this object are in the table only, and a warning says so; likewise if the name would
        be too long for a file

    Raises
    ------
    VideoError
        From the constructor if the folder cannot be written to; later if a write fails.
    """

    def __init__(self, directory: str | Path, name: str, *, again: bool = False) -> None:
        self.directory, self.name = Path(directory), name
        self.rows = 0
        self._continues = self._again = again
        self._objects: dict[str, list[LineFile]] = {}  # the files of each object that has appeared
        self._files = contextlib.ExitStack()
        with writing(self.directory, VideoError):
            self.directory.mkdir(parents=True, exist_ok=True)
            self._table = self._open(CsvSink(self.directory / table_file(name), again=again))

    def write(self, tracks: Sequence[Track], seconds: float) -> None:
        """Add the tracks of one frame and its processing time. A frame that already has a row is skipped."""
        frame = tracks[0].frame
        if frame < self.rows:
            return
        found = {track.object: track for track in tracks}
        for thing in found:
            if thing not in self._objects:
                self._begin(thing)
        for thing, files in self._objects.items():
            row = _row(found[thing], seconds) if thing in found else _NOTHING
            for file, text, nothing in zip(files, row, _NOTHING, strict=False):
                file.add((frame - self.rows) * f"{nothing}\n" + f"{text}\n")
        self._table.write(tracks)
        self.rows = frame + 1

    def publish(self) -> None:
        """Take the place of the files that are written again."""
        for file in [*(file for files in self._objects.values() for file in reversed(files)), self._table]:
            file.publish()
        self._again = False

    def close(self) -> None:
        """Close the files."""
        self._files.close()

    def _begin(self, thing: str) -> None:
        """Open the files of an object, with a row for each frame so far."""
        paths = [self.directory / file for file in object_files(self.name, thing)]
        fits = all(map(name_fits, paths))
        taken = _is_taken(self.directory, self.name, thing) or (thing and not self._continues and paths[0].exists())
        self._objects[thing] = []
        if taken or not fits:
            reason = "exists already and is kept" if fits else "would be too long a name"
            _log.warning("%s %s: the boxes of %s are in %s only", paths[0], reason, thing, table_file(self.name))
            return
        for path, nothing in reversed([*zip(paths, _NOTHING, strict=True)]):
            with writing(path, VideoError):
                file = self._open(LineFile(path, again=self._again))
            file.add(self.rows * f"{nothing}\n")
            self._objects[thing].insert(0, file)

    def _open(self, file: _File) -> _File:
        return self._files.enter_context(contextlib.closing(file))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_seconds(directory: Path, name: str) -> dict[int, float]:
    """Return the processing time of each frame that has one in the files of a run."""
    seconds: dict[int, float] = {}
    for thing in {UNNAMED, *objects_of(directory, name)}:
        path = directory / object_files(name, thing)[2]
        for frame, row in enumerate(path.read_text(errors="replace").split("\n")[:-1] if path.exists() else ()):
            with contextlib.suppress(ValueError):  # of a row that a power cut has damaged
                if not math.isnan(value := float(row)):
                    seconds[frame] = value
    return seconds


def _row(track: Track, seconds: float) -> tuple[str, str, str]:
    """Return the row of a track in each of the files of its object."""
    box = _NOTHING[0] if track.box is None else format_box(track.box)
    return box, f"{track.score:.6f}", f"{seconds:.6f}"
