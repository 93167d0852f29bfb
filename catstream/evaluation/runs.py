"""The output of one tracker on one sequence, and its files.

The files have the layouts of the benchmarks' toolkits:

    TRACKER/NAME.txt, TRACKER/times/NAME_time.txt      got10k's layout for OTB
    TRACKER/longterm/NAME/NAME_001.txt                 that of the VOT toolkit's long-term experiment, with
                          NAME_001_confidence.value    the confidence
                          NAME_001_time.value          and seconds a frame
    catstream/settings.json                            settings and versions of the runs

A run is stored as a sequence of its own: NAME if it starts with the first box of the ground truth, otherwise
NAME@FRAME (a later frame), NAME@VARIATION (a changed initial box, for example walk@left) or NAME@FRAME-VARIATION.
"""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.files import write_atomically, writing
from catstream.base.settings import Settings
from catstream.base.text import cause_of
from catstream.errors import CatstreamError, SettingsError, VideoError
from catstream.evaluation.datasets import Sequence, Start
from catstream.evaluation.peers import OPENCV
from catstream.evaluation.scores import Score, score

#: Layout -> the files of boxes, scores and times of a run: the toolkits of got10k (for OTB) and VOT read them.
_LAYOUTS = {
    "otb": ("{0}.txt", "{0}_confidence.value", "times/{0}_time.txt"),
    "vot": ("{0}/{0}_001.txt", "{0}/{0}_001_confidence.value", "{0}/{0}_001_time.value"),
}


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationRun:
    """The output of one tracker on one sequence from one start.

    tracker     name of the tracker
    sequence    the whole sequence
    start       frame and variation of the initial box
    boxes       float64 (frames, 4) from this frame on, the first as given; NaN if the tracker reported no box
    confidence  float64 (frames,)
    seconds     float64 (frames,), time of the tracker alone, without reading the frame
    """

    tracker: str
    sequence: Sequence
    start: Start
    boxes: Float64
    confidence: Float64
    seconds: Float64

    @property
    def name(self) -> str:
        """Name of the sequence and of the start."""
        return self.sequence.name + self.start.suffix

    @property
    def truth(self) -> Float64:
        """Ground truth of the frames of this run, float64 (frames, 4)."""
        return self.sequence.boxes[self.start.frame :]

    @property
    def fps(self) -> float:
        """Frames per second without the first frame, which initialises the tracker."""
        return (len(self.seconds) - 1) / max(float(self.seconds[1:].sum()), 1e-9)

    def score(self) -> Score:
        return score(self.boxes, self.truth, self.confidence)


def prepare_folder(output: Path, settings: Settings) -> None:
    """Make the folder for runs; SettingsError if runs in it were made with other settings or versions."""
    file = output / "catstream" / "settings.json"
    values = settings.values() | {"catstream": version("catstream"), "opencv": OPENCV}
    with writing(output):
        if file.exists():
            before = json.loads(file.read_text(encoding="utf-8"))
            changed = sorted(key for key in {*before, *values} if before.get(key) != values.get(key))
            if changed:
                raise SettingsError(
                    f"the runs in {str(output)!r} were made with other settings or versions ({', '.join(changed)}): "
                    "pass another --output, or remove that folder"
                )
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file, (json.dumps(values, indent=1) + "\n").encode())


def _files(output: Path, tracker: str, name: str) -> list[Path]:
    """Return the paths of boxes, confidence and times of a run in the VOT toolkit's layout."""
    return [output / tracker / "longterm" / pattern.format(name) for pattern in _LAYOUTS["vot"]]


def _write_layout(
    layout: str, folder: Path, name: str, boxes: Float64, confidence: Float64 | None, seconds: Float64 | None
) -> None:
    """Write the files of one object in one of the `_LAYOUTS`.

    boxes : float64 (frames, 4), x, y, w, h in pixels; NaN if there is none
    confidence, seconds : score and processing time, float64 (frames,); None to write no such file
    """
    values = (boxes, confidence, seconds)
    for pattern, column, form in zip(_LAYOUTS[layout], values, ("%.4f", "%.6f", "%.8f"), strict=True):
        if column is not None:
            file = folder / pattern.format(name)
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(file, column, fmt=form, delimiter=",")


def save(output: Path, run: EvaluationRun) -> None:
    """Write a run. The folder in VOT's layout is renamed into place last: its existence marks the run as complete."""
    folder, home = _files(output, run.tracker, run.name)[0].parent, output / run.tracker
    part = home / f"{run.name}.part"
    shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)
    with writing(home):
        _write_layout("otb", home, run.name, run.boxes, None, run.seconds)
        _write_layout("vot", part, run.name, run.boxes, run.confidence, run.seconds)
        folder.parent.mkdir(exist_ok=True)
        (part / run.name).rename(folder)
        part.rmdir()


def load(output: Path, tracker: str, sequence: Sequence, start: Start) -> EvaluationRun | None:
    """Return a complete run, or None if there is none or it started with another box."""
    boxes, confidence, seconds = _files(output, tracker, sequence.name + start.suffix)
    if not boxes.parent.is_dir():
        return None
    try:
        run = EvaluationRun(
            tracker,
            sequence,
            start,
            np.loadtxt(boxes, delimiter=",", ndmin=2),
            np.loadtxt(confidence, ndmin=1),
            np.loadtxt(seconds, ndmin=1),
        )
    except (OSError, ValueError) as error:
        raise CatstreamError(
            f"{str(boxes.parent)!r} cannot be read ({cause_of(error)}): remove it to repeat the run"
        ) from None
    if not len(sequence) - start.frame == len(run.boxes) == len(run.confidence) == len(run.seconds):
        return None
    return run if _has_first_box(run) else None


def _has_first_box(run: EvaluationRun) -> bool:
    """Return whether a stored run has the initial box of its start. Only if it may have been moved is a frame read."""
    if np.array_equal(run.boxes[0], np.round(run.start.box(run.sequence), 4)):
        return True
    if run.start.variation.name:
        with suppress(VideoError):  # the run is repeated, and reports the error
            size = run.sequence.size(run.start.frame)
            return np.array_equal(run.boxes[0], np.round(run.start.box(run.sequence, size), 4))
    return False
