"""What one tracker answered on one sequence, and how that is kept.

Results lie where the benchmarks' toolkits look for them:

    TRACKER/NAME.txt, TRACKER/times/NAME_time.txt      got10k's layout for OTB
    TRACKER/longterm/NAME/NAME_001.txt                 that of the VOT toolkit's long-term experiment, with
                          NAME_001_confidence.value    the confidence
                          NAME_001_time.value          and seconds a frame
    catstream/settings.json                            what the runs of catstream were made with

A run that starts later than at the first frame is a sequence NAME@FRAME of its own.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from catstream.errors import CatstreamError, SettingsError, VideoError
from catstream.evaluation.datasets import Sequence
from catstream.evaluation.metrics import Score, score
from catstream.evaluation.peers import OPENCV
from catstream.settings import Settings

__all__ = ["EvaluationRun", "load", "prepare_folder", "run_name", "save"]


@dataclass(frozen=True, slots=True, eq=False)
class EvaluationRun:
    """What one tracker answered on one sequence from one start.

    tracker     its name
    sequence    followed, the whole of it
    start       row of its boxes that the tracker was given
    boxes       float64 (frames, 4) from there on; NaN where it found nothing
    confidence  float64 (frames,)
    seconds     float64 (frames,), of the tracker alone, without reading the frame
    """

    tracker: str
    sequence: Sequence
    start: int
    boxes: np.ndarray
    confidence: np.ndarray
    seconds: np.ndarray

    @property
    def name(self) -> str:
        """Of the sequence, and where it was started if not at the front."""
        return run_name(self.sequence, self.start)

    @property
    def truth(self) -> np.ndarray:
        """The boxes to compare with, float64 (frames, 4)."""
        return self.sequence.boxes[self.start :]

    @property
    def fps(self) -> float:
        """Frames a second, the first one (which sets the tracker up) apart."""
        return (len(self.seconds) - 1) / max(float(self.seconds[1:].sum()), 1e-9)

    def score(self) -> Score:
        """Its measures."""
        return score(self.boxes, self.truth, self.confidence)


def run_name(sequence: Sequence, start: int) -> str:
    """What a run is called."""
    return f"{sequence.name}@{start}" if start else sequence.name


def prepare_folder(output: Path, settings: Settings) -> None:
    """Make the folder for runs, and see that those in it were made with these settings, and these versions.

    Raises
    ------
    SettingsError
        Where they were not: names the settings that differ.
    VideoError
        Where the folder cannot be written.
    """
    file = output / "catstream" / "settings.json"
    values = settings.values() | {"catstream": version("catstream"), "opencv": OPENCV}
    try:
        if file.exists():
            before = json.loads(file.read_text(encoding="utf-8"))
            changed = sorted(key for key in {*before, *values} if before.get(key) != values.get(key))
            if changed:
                raise SettingsError(
                    f"the runs in {str(output)!r} were made with other settings or versions ({', '.join(changed)}): "
                    "give another --output, or remove that folder"
                )
        else:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise VideoError(f"cannot write results to {str(output)!r} ({error.strerror}): give another folder") from None


def _files(output: Path, tracker: str, name: str) -> tuple[Path, Path, Path]:
    """Boxes, confidence and times of a run, in the VOT toolkit's layout."""
    folder, stem = output / tracker / "longterm" / name, f"{name}_001"
    return folder / f"{stem}.txt", folder / f"{stem}_confidence.value", folder / f"{stem}_time.value"


def save(output: Path, run: EvaluationRun) -> None:
    """Write a run; the folder of VOT's layout appears last and whole, so that it says: finished.

    Raises
    ------
    VideoError
        Where it cannot be written.
    """
    boxes, confidence, seconds = _files(output, run.tracker, run.name)
    folder, home = boxes.parent, output / run.tracker
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)
    try:
        for made in (part, home / "times"):
            made.mkdir(parents=True, exist_ok=True)
        np.savetxt(home / f"{run.name}.txt", run.boxes, fmt="%.4f", delimiter=",")
        np.savetxt(home / "times" / f"{run.name}_time.txt", run.seconds, fmt="%.8f")
        np.savetxt(part / boxes.name, run.boxes, fmt="%.4f", delimiter=",")
        np.savetxt(part / confidence.name, run.confidence, fmt="%.6f")
        np.savetxt(part / seconds.name, run.seconds, fmt="%.8f")
        part.rename(folder)
    except OSError as error:
        raise VideoError(f"its result cannot be written to {str(home)!r} ({error.strerror}): make room") from None


def load(output: Path, tracker: str, sequence: Sequence, start: int) -> EvaluationRun | None:
    """A finished run, or None where there is none, or it began on another box.

    Raises
    ------
    CatstreamError
        Where there is one that cannot be read.
    """
    boxes, confidence, seconds = _files(output, tracker, run_name(sequence, start))
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
            f"{str(boxes.parent)!r} cannot be read ({error}): remove it, and it is made again"
        ) from None
    if not len(sequence) - start == len(run.boxes) == len(run.confidence) == len(run.seconds):
        return None
    return run if np.array_equal(run.boxes[0], run.truth[0].round(4)) else None
