"""Results of a run as text files: a row a frame, flushed as it is written.

    NAME.txt               x,y,w,h in pixels; nan,nan,nan,nan where the object is absent
    NAME_confidence.value  the score
    NAME_time.txt          seconds of work that the frame took
    tracks.csv             frame, seconds since the start of the source, state, x, y, w, h, score, model_version

The first three are what the benchmarks' toolkits read. Two lockstep runs write
the same NAME.txt, NAME_confidence.value and tracks.csv, byte for byte;
NAME_time.txt is measured and is never the same twice.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Self

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages import Track

__all__ = ["COLUMNS", "ResultsWriter", "row"]

#: Of tracks.csv.
COLUMNS = "frame,seconds,state,x,y,w,h,score,model_version"

_ABSENT = "nan,nan,nan,nan"


def row(track: Track) -> str:
    """The row of a track in tracks.csv."""
    box = ",,," if track.box is None else _sides(track.box)
    return f"{track.frame},{track.time:.6f},{track.state},{box},{track.score:.6f},{track.model_version}"


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

    Raises
    ------
    VideoError
        Where the directory cannot be written to, before any work is done.
    """

    def __init__(self, directory: str | Path, name: str, start: int = 0) -> None:
        self.directory = Path(directory)
        self.rows = start
        with contextlib.ExitStack() as files:
            try:
                self.directory.mkdir(parents=True, exist_ok=True)
                self._boxes, self._scores, self._times, self._tracks = (
                    files.enter_context((self.directory / file).open("w", encoding="ascii", buffering=1))
                    for file in (f"{name}.txt", f"{name}_confidence.value", f"{name}_time.txt", "tracks.csv")
                )
            except OSError as error:
                raise VideoError(
                    f"cannot write results to {str(directory)!r} ({error.strerror}): "
                    "give a folder that exists or can be made, and that you may write to"
                ) from None
            self._files = files.pop_all()
        self._tracks.write(COLUMNS + "\n")

    def write(self, track: Track, seconds: float) -> None:
        """Add one frame, and the seconds of work it took. A frame that has its row already is skipped."""
        if track.frame < self.rows:
            return
        for _ in range(track.frame - self.rows):
            self._row(_ABSENT, "nan", "nan")
        self._row(_ABSENT if track.box is None else _sides(track.box), f"{track.score:.6f}", f"{seconds:.6f}")
        self._tracks.write(row(track) + "\n")
        self.rows = track.frame + 1

    def _row(self, box: str, score: str, seconds: str) -> None:
        for file, text in ((self._boxes, box), (self._scores, score), (self._times, seconds)):
            file.write(text + "\n")

    def close(self) -> None:
        """Close the files; what was written stays."""
        self._files.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
